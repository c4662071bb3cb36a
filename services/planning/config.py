"""What can be tuned in the planner; a profile's `[service.planning]` table sets these."""

from __future__ import annotations

from typing import Literal

import msgspec

from cocoro.units import Positive


class MemoryConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Of the target memory's filter."""

    sigma_m: Positive = 0.004
    """Standard deviation of a position at no distance; grows by `sigma_per_m` with the distance."""
    sigma_per_m: Positive = 0.006
    doubtful_factor: Positive = 4.0
    """For detections that are occluded or cut by the image's edge."""
    acceleration_mps2: Positive = 0.08
    """How restless an object is expected to be; grows by itself when the object proves to move."""
    velocity_fade_s: Positive = 0.8
    """An unseen object's velocity fades with this time constant."""
    gate_sigmas: Positive = 6.0
    gate_m: Positive = 0.08
    """A sighting further off than both is an outlier; three that agree move the memory."""
    forget_s: Positive = 120.0


class HeadConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    sweep_speed_radps: Positive = 0.9
    sweep_pan_rad: Positive = 2.6
    sweep_ahead_rad: Positive = 1.05
    """How far to the first side it looks before it looks everywhere."""
    sweep_tilts_rad: tuple[float, float] = (-0.30, -0.92)
    """For the floor from 0.9 m on, and for that from 0.2 to 1.2 m (the camera stands 0.73 m high)."""
    tilt_range_rad: tuple[float, float] = (-1.2, 0.5)
    """Further down it would look at itself, and the camera's housing comes near its mount."""
    fixate_speed_radps: Positive = 4.0
    look_where_it_was_s: Positive = 1.5
    """A remembered object is looked for at its place for so long before sweeping."""


class NavigationConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    max_speed_mps: Positive = 0.35
    max_turn_radps: Positive = 0.9
    acceleration_mps2: Positive = 0.5
    turn_acceleration_radps2: Positive = 2.5
    turn_in_place_rad: Positive = 0.9
    """Further off than this it turns on the spot first."""
    detour_speed_mps: Positive = 0.28
    clearance_m: Positive = 0.05
    """The body keeps so far from what stands on the floor (half of it before it stops by itself)."""
    comfort_m: Positive = 0.45
    """Ways nearer to something than this cost more."""
    hand_half_width_m: Positive = 0.10
    """With open claws, and some room."""
    last_stretch_m: Positive = 0.45
    """Over so much before a target the hand is out and low."""
    swing_room_m: Positive = 0.06
    """To anything tall while the arm unfolds."""
    unfold_by_m: Positive = 0.30
    """Before so much is left to drive the arm has to be out."""
    stuck_s: Positive = 8.0
    glance_s: Positive = 1.5
    """A place ahead that is still hidden after so long is passed over."""
    distance_tolerance_m: Positive = 0.012
    heading_tolerance_rad: Positive = 0.05


class ArmConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    joint_speed_radps: Positive = 1.6
    hand_speed_mps: Positive = 0.25
    insert_speed_mps: Positive = 0.12
    lift_speed_mps: Positive = 0.12
    damping: Positive = 0.02
    """Of the damped pseudo-inverse, metres."""
    pitch_rad: float = -0.17
    travel_radius_m: Positive = 0.37
    travel_height_m: Positive = 0.20
    grasp_radius_m: Positive = 0.49
    """Where a target should stand for grasping: from the arm base's axis."""
    grasp_radius_range_m: tuple[float, float] = (0.468, 0.535)
    """Nearer, the open claws would come down on the target; further, the arm does not reach."""
    touch_radius_range_m: tuple[float, float] = (0.44, 0.56)
    """What hangs is touched from behind alone, so nothing comes down on it."""
    grasp_azimuth_range_rad: tuple[float, float] = (-0.45, 0.45)
    grasp_height_range_m: tuple[float, float] = (0.045, 0.30)
    retreat_radius_m: Positive = 0.37
    """Where the hand waits behind a target before it closes in: as near as the arm folds at that height."""
    descend_at_m: Positive = 0.45
    """While driving, the hand comes down when so much is left to drive."""
    carry_radius_m: Positive = 0.38
    carry_rise_m: Positive = 0.17
    """How much higher than where it was grasped a thing is carried."""
    clearance_m: Positive = 0.008
    """The arm's hull stays so far from the camera mount, the chassis and the floor."""
    stall_s: Positive = 1.0
    """A joint that cannot follow for so long is held up by something."""
    lead_rad: Positive = 0.25
    """A joint's goal never runs further ahead of where the joint is."""


class HandConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    open_rad: Positive = 0.42
    close_rad: Positive = 0.30
    """How far the claws close on nothing: well past where they would touch a target."""
    clamp_rad: Positive = 0.10
    """How far past where it was stopped each claw pushes on."""
    speed_radps: Positive = 1.2
    grip_load: Positive = 0.25
    """Share of the stall torque, closing, at which a stopped claw is held to have something."""
    settle_s: Positive = 0.25
    give_up_s: Positive = 2.0


class FollowConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Of the pursuit of a moving target."""

    distance_m: Positive = 0.80
    """From the body's centre to the target, level; the Kinect is blind below 0.5 m."""
    max_speed_mps: Positive = 0.48
    gain_per_s: Positive = 1.2
    turn_gain_per_s: Positive = 2.4
    lost_s: Positive = 1.0
    """Not seen for longer, it is looked for where it was going."""
    give_up_s: Positive = 25.0


class HandSightConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Of seeing the own hand while reaching."""

    follow_s: Positive = 0.4
    """What is felt follows what is seen with this time constant."""
    speed_mps: Positive = 0.03
    """And no faster than this."""
    lately_s: Positive = 0.4
    """A hand that was not seen for longer is felt."""
    fade_s: Positive = 6.0
    """A correction that is not renewed fades with this time constant."""
    wild_m: Positive = 0.12
    """A marker further than this from where the hand is felt is something else."""
    roll_rad: Positive = 0.1
    """The marker's place is known while the claws lie level, within so much."""


class PlanningConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    rate_hz: Positive = 50.0
    marker: str = "hand_marker"
    """The label of the ball on the hand, which is no object of the room."""
    model: str = ""
    """The file of what was learned of the body; empty: nothing. One that is refused leaves the rigid body."""
    reach: Literal["learned", "rigid"] = "learned"
    """Rigid: the drawing's own kinematics, whatever was learned of the arm."""
    adapt: bool = False
    """Sightings of the hand at work go on teaching a learned map."""
    see_hand: bool = False
    """Bring the rigid body's hand to where its marker is seen, too; with a learned map that is always done."""
    sight: HandSightConfig = HandSightConfig()
    memory: MemoryConfig = MemoryConfig()
    head: HeadConfig = HeadConfig()
    navigation: NavigationConfig = NavigationConfig()
    arm: ArmConfig = ArmConfig()
    hand: HandConfig = HandConfig()
    follow: FollowConfig = FollowConfig()
    blind_periods: Positive = 2.0
    """As many of its own periods perception may be silent where that is longer than `Base.command_timeout_s`: one that
    is slow may be silent for longer."""
    blind_for_good_s: Positive = 5.0
    """What needs to see fails when perception has been silent for so much longer than that."""
    odometry_gap_s: Positive = 0.1
    """Odometry is interpolated over no more than this."""
    stale_target_s: Positive = 4.0
    """On the last stretch or while reaching, a target not seen for longer is lost."""
    stale_on_way_s: Positive = 45.0
    """The same on the way around something, which may hide it."""
