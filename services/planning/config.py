"""Parameters of the planner; a profile sets them in `[service.planning]`."""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from cocoro.units import Positive


class MemoryConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The filter of the target memory."""

    sigma_m: Positive = 0.004
    """Standard deviation of a measured position at distance 0; it grows by `sigma_per_m` per metre."""
    sigma_per_m: Positive = 0.006
    doubtful_factor: Positive = 4.0
    """Factor on the standard deviation of detections that are occluded or cut by the image's edge."""
    acceleration_mps2: Positive = 0.08
    """Expected acceleration of an object; the filter increases it for an object that moves."""
    drift_rad_per_m: Positive = 0.06
    """Standard deviation of odometry's heading per metre driven: of wheels whose sizes differ by 1.6 percent."""
    drift_share: Positive = 0.015
    """Standard deviation of odometry's distance, and of its turn, as a share of them."""
    velocity_fade_s: Positive = 0.8
    """Time constant with which the velocity of an unseen object decays."""
    gate_sigmas: Positive = 6.0
    gate_m: Positive = 0.08
    """A sighting further off than both gates is an outlier; three that agree move the memory."""
    forget_s: Positive = 120.0


class HeadConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    sweep_speed_radps: Positive = 0.9
    """Speed over floor that no picture has shown yet, with a camera that sees while it turns."""
    sweep_pan_rad: Positive = 2.6
    """The sweep looks so far to both sides."""
    sweep_step_rad: Positive = 0.66
    """Largest pan between two aims of the sweep. The camera sees 1.0 rad, of which the edge does not count as seen."""
    sweep_tilts_rad: tuple[float, float] = (-0.40, -0.92)
    """For the floor from 0.75 m on, and from 0.2 to 1.2 m (the camera is 0.73 m high)."""
    middle_tilt_rad: float = -0.60
    middle_m: tuple[float, float] = (0.55, 1.0)
    """At the middle tilt the camera sees the floor from the first distance on. Floor nearer than the second belongs to
    the near tilt of a sweep where both are needed."""
    view_margin_rad: Positive = 0.08
    """What is nearer to the picture's edge may be cut off."""
    view_rad: Positive = 0.38
    """Half of the width that a glance shows for certain; half of the camera's field of view is 0.5."""
    between_speed_radps: Positive = 2.5
    """Speed between two parts of the floor that are to be looked at."""
    tilt_range_rad: tuple[float, float] = (-1.2, 0.5)
    """Below it the camera sees the robot itself, and its housing comes near the mount."""
    fixate_speed_radps: Positive = 4.0
    body_turn_radps: Positive = 0.9
    """Greatest rate at which the base turns to look about, on a robot whose camera is fixed on the body."""
    look_where_it_was_s: Positive = 1.5
    """Time for which a remembered object is looked for at its place before a sweep."""


class SearchConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The search for an object that is not in view: the floor that must be seen, and from where."""

    radius_m: Annotated[float, Meta(gt=0, le=2.8)] = 2.0
    """The floor is searched up to this distance from where the task began."""
    sight_m: Positive = 2.6
    """Distance up to which floor counts as seen: the smallest object is found there."""
    turning_radps: Positive = 1.4
    """A camera that turns faster finds nothing."""
    margin_m: Positive = 0.5
    """How far into unseen floor a place to look from is expected to see."""
    outside_m: float = 0.3
    """How far outside of the radius the robot goes to look into it."""
    least_m2: Positive = 0.01
    """Least unseen floor for which the robot goes to another place."""
    least_foot_m2: Positive = 0.0075
    """Least unseen floor at the feet of walls for which it goes to another place, once all other floor was seen."""
    max_speed_mps: Positive = 0.35
    max_turn_radps: Positive = 0.9
    """On the way: a camera that turns faster does not correct the body's pose."""
    drive_mps: Positive = 0.2
    turn_radps: Positive = 0.7
    look_s: Positive = 5.0
    """Speeds on the way and time for a look, by which places to look from are compared."""
    steady_s: Positive = 0.3
    """Time for which the head rests at the end of a look."""


class NavigationConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    max_speed_mps: Positive = 0.48
    max_turn_radps: Positive = 1.6
    acceleration_mps2: Positive = 1.0
    turn_acceleration_radps2: Positive = 5.0
    turn_in_place_rad: Positive = 0.9
    """Above this heading error the robot turns on the spot first."""
    detour_speed_mps: Positive = 0.28
    clearance_m: Positive = 0.05
    """Distance that planned paths keep between the body and obstacles; at half of it the robot stops."""
    comfort_m: Positive = 0.45
    """Paths nearer to an obstacle than this cost more."""
    hand_half_width_m: Positive = 0.10
    """With open claws and a margin."""
    last_stretch_m: Positive = 0.45
    """Length of the path before a target on which the hand is extended and low."""
    swing_room_m: Positive = 0.06
    """Distance from tall obstacles while the arm unfolds."""
    unfold_by_m: Positive = 0.30
    """Remaining distance by which the arm must be unfolded."""
    stuck_s: Positive = 8.0
    glance_s: Positive = 1.5
    """Time after which a place ahead that stays hidden counts as seen."""
    blind_mps: Positive = 0.12
    """Speed over unseen floor that is too near to be seen by a camera that is fixed on the body."""
    distance_tolerance_m: Positive = 0.012
    heading_tolerance_rad: Positive = 0.05
    turn_gain_per_s: Positive = 3.0
    coasting_mps: Positive = 0.3
    """Below this speed the hand reaches out while the base still brakes."""


class ArmConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    joint_speed_radps: Positive = 2.4
    swing_radps: Positive = 1.8
    """Speed at which the arm swings to the front while the base drives fast: a swing that ends abruptly while the
    wheels brake as hard as they can makes them slip."""
    hand_speed_mps: Positive = 0.5
    insert_speed_mps: Positive = 0.35
    lift_speed_mps: Positive = 0.25
    damping: Positive = 0.02
    """Damping of the pseudo-inverse, m."""
    pitch_rad: float = -0.17
    travel_radius_m: Positive = 0.37
    travel_height_m: Positive = 0.20
    grasp_radius_m: Positive = 0.49
    """Preferred distance of a target from the arm base's axis for grasping."""
    grasp_radius_range_m: tuple[float, float] = (0.468, 0.535)
    """Nearer, the open claws would come down on the target; beyond, the arm does not reach it."""
    touch_radius_range_m: tuple[float, float] = (0.44, 0.56)
    """Range for touching: the hand comes from behind, so nothing comes down on the target."""
    grasp_sigma_m: Positive = 0.016
    """Standard deviation of a target's place up to which the hand reaches for it; with more it waits to see it again.
    The open claws leave three times as much."""
    grasp_azimuth_range_rad: tuple[float, float] = (-0.45, 0.45)
    grasp_height_range_m: tuple[float, float] = (0.045, 0.30)
    retreat_radius_m: Positive = 0.37
    """Where the hand waits behind a target before it closes in: the smallest radius that the arm reaches."""
    descend_at_m: Positive = 0.45
    """Remaining distance at which the hand comes down while driving."""
    carry_radius_m: Positive = 0.38
    carry_rise_m: Positive = 0.17
    """Height at which an object is carried above where it was grasped."""
    clearance_m: Positive = 0.008
    """Least distance of the arm's hull from the camera mount, the chassis and the floor."""
    stall_s: Positive = 1.0
    """A joint that lags behind its goal for this long is blocked."""
    lead_rad: Positive = 0.25
    """Largest lead of a joint's goal over its measured angle."""
    wait_rad: Positive = 0.17
    """The goals of all joints wait for one that lags by more: up to 0.15 rad are seen where nothing is late."""
    wait_s: Positive = 0.5
    """Longest wait: a link that lost a packet has repeated it by then."""


class HandConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    open_rad: Positive = 0.42
    close_rad: Positive = 0.30
    """Closing angle: well past the angle at which the claws touch a target."""
    clamp_rad: Positive = 0.10
    """Angle beyond the contact at which each claw keeps pushing."""
    speed_radps: Positive = 1.2
    grip_load: Positive = 0.25
    """Closing load, as a share of the stall torque, at which a stopped claw counts as holding something."""
    fixed_finger_room_m: Positive = 0.010
    """With one jaw: what the fixed finger leaves at least between itself and the target as the hand closes in."""
    settle_s: Positive = 0.25
    give_up_s: Positive = 2.0


class FollowConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Pursuit of a moving target."""

    distance_m: Positive = 0.80
    """Horizontal distance from the body's centre to the target; the Kinect sees no depth below 0.5 m."""
    max_speed_mps: Positive = 0.48
    gain_per_s: Positive = 1.2
    turn_gain_per_s: Positive = 2.4
    round_speed_mps: Positive = 0.40
    """Speed on the way round what stands between."""
    lost_s: Positive = 1.0
    """After this time unseen the target is looked for where it was last going."""
    give_up_s: Positive = 25.0


class ByHandConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Driving by hand. Base and turn have the limits of `NavigationConfig`."""

    unseen_mps: Positive = 0.12
    """Over floor that was never seen."""
    crawl_mps: Positive = 0.08
    """Backwards, where the camera sees nothing."""
    arm_out_mps: Positive = 0.28
    """With the arm unfolded."""
    just_been_s: Positive = 60.0
    """The robot may back over floor on which it stood in this time, though no picture has shown it."""
    hand_mps: Positive = 0.20
    hand_radps: Positive = 0.5
    """Of the hand about the arm's axis."""
    roll_radps: Positive = 1.5
    radius_m: tuple[float, float] = (0.30, 0.60)
    azimuth_rad: tuple[float, float] = (-1.4, 0.55)
    """Further to the left the arm is in the plane that it parks in."""
    height_m: tuple[float, float] = (0.03, 0.60)
    lead_m: Positive = 0.02
    lead_rad: Positive = 0.06
    """The wanted pose is at most so far ahead of the commanded one, so that the hand stops with the operator's."""
    hull_m: Positive = 0.02
    """Least distance of the unfolded arm from obstacles while the base moves."""
    low_m: Positive = 0.20
    """Parts of the arm that are lower do not pass over known objects."""
    head_radps: Positive = 1.5
    head_lead_rad: Positive = 0.25
    look_after_s: Positive = 2.0
    """So long after the operator moved the head it looks by itself at unseen floor ahead."""


class PolicyConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Following the actions that a learned policy proposes. Base and hull have the limits of `ByHandConfig`."""

    start_s: Positive = 60.0
    """Longest wait for the first actions: the policy is loaded meanwhile."""
    silent_s: Positive = 1.0
    """So long without actions that count the robot stands; then the task fails."""
    hold_s: Annotated[float, Meta(ge=0)] = 0.15
    """The last row of a chunk counts for so long after its own period, while the next chunk is late."""
    oldest_s: Positive = 2.0
    """Rows of a later time after the observation do not count: too much may have changed since."""
    ahead_s: Positive = 0.15
    """The arm's hull is kept from obstacles where it will be after this time."""
    grip_rad: Positive = 0.05
    """Jaws whose goals are further than this from where they are open or close."""


class HandSightConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Correction of the reach by the sight of the own hand."""

    follow_s: Positive = 0.4
    """Time constant with which the correction follows the sightings."""
    speed_mps: Positive = 0.03
    """Greatest speed of the correction."""
    lately_s: Positive = 0.4
    """After this time without a sighting the hand counts as unseen."""
    fade_s: Positive = 6.0
    """Time constant with which a correction without new sightings decays."""
    wild_m: Positive = 0.12
    """A marker further than this from the computed hand is ignored."""
    roll_rad: Positive = 0.1
    """Tolerance of the wrist roll about level, at which the marker's position is known."""


class PlanningConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    rate_hz: Positive = 50.0
    objects: str | None = None
    """Path of a catalogue file, for the sizes of the known objects; the project's own by default."""
    marker: str = "hand_marker"
    """Label of the ball on the hand, which is no obstacle and no target."""
    model: str = ""
    """File of the learned model; empty: none. If it is refused, the planner uses the nominal model."""
    reach: Literal["learned", "rigid"] = "learned"
    """Rigid: the nominal kinematics, even where the arm was learned."""
    adapt: bool = False
    """Keep training a learned map with the sightings of the hand at work."""
    see_hand: bool = False
    """Correct the nominal model's hand by the sight of its marker, too; with a learned map that is always done."""
    sight: HandSightConfig = HandSightConfig()
    memory: MemoryConfig = MemoryConfig()
    head: HeadConfig = HeadConfig()
    search: SearchConfig = SearchConfig()
    navigation: NavigationConfig = NavigationConfig()
    arm: ArmConfig = ArmConfig()
    hand: HandConfig = HandConfig()
    follow: FollowConfig = FollowConfig()
    by_hand: ByHandConfig = ByHandConfig()
    policy: PolicyConfig = PolicyConfig()
    blind_periods: Positive = 2.0
    """The robot drives on without news of perception for this many of perception's own periods where that is longer
    than `Base.command_timeout_s`, so that a slow perception does not stop it."""
    blind_for_good_s: Positive = 5.0
    """A task that needs sight fails when there is no news of perception for this much longer. Until then the robot
    stands, and goes on when there is some."""
    stale_for_good_s: Positive = 5.0
    """The same for the states of base, arm and hand, which every task needs."""
    odometry_gap_s: Positive = 0.1
    """Longest gap over which odometry is interpolated."""
    stale_target_s: Positive = 4.0
    """On the last stretch and while reaching, a target unseen for longer is lost."""
    stale_on_way_s: Positive = 45.0
    """`stale_target_s` on a detour, where an obstacle may hide the target."""
