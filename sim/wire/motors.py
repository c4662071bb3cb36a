"""The PyBullet robot's motors as firmware drives them: by registers and wheel speeds instead of messages."""

from __future__ import annotations

from collections.abc import Mapping
from math import radians

from cocoro.robot import Base, Joint, Robot
from sim.base import MobileBase
from sim.realism import BodyRealism
from sim.servos import LOAD_COUNTS, SPEED_COUNT_RADPS, Drive, Servo, ServoNetwork
from sim.wire.dynamixel import Motor
from sim.world import NETWORKS, Motors

LIMP_SHARE = 0.05
"""What the gears of a limp servo resist with, as a share of its stall torque."""
LIMP_RADPS = 1.0


class WireServo(Servo):
    """Does what its registers say."""

    def __init__(self, joint: Joint, angle_rad: float, backlash_rad: float) -> None:
        super().__init__(joint, angle_rad, backlash_rad)
        # Stiff until the firmware speaks, so that the robot stands as it was left.
        self.motor = Motor(on=True, goal=self.goal_count, speed=0, limit=1.0, slope=1, punch=1.0)

    def drive(self, speed_factor: float = 1.0) -> Drive:
        motor, joint = self.motor, self.joint
        if not motor.on or motor.limit <= 0.0:
            return Drive(self.angle_rad, LIMP_RADPS, LIMP_SHARE * joint.torque_nm)
        error_counts = motor.goal - self.count
        share = min(max(abs(error_counts) / motor.slope, motor.punch), 1.0)
        speed_radps = min((motor.speed or LOAD_COUNTS) * SPEED_COUNT_RADPS * speed_factor, joint.max_speed_radps)
        error_rad = joint.to_angle(motor.goal) - self._play.shaft_rad
        return Drive(self.angle_rad + error_rad, speed_radps, joint.torque_nm * motor.limit * share)

    @property
    def senses(self) -> tuple[int, int, float]:
        """Position, speed (counts) and load (share), in the servo's own sense of turning."""
        sign = self.joint.direction
        return self.count, round(sign * self.speed_radps / SPEED_COUNT_RADPS), sign * self.load


class WireNetwork(ServoNetwork):
    """Servos that hear nothing but their registers: commands, expiry and the emergency stop are the driver's."""

    def __init__(self, joints: Mapping[str, Joint], angles_rad: Mapping[str, float], backlash_deg: float) -> None:
        super().__init__(joints, angles_rad, keeps_goal=True, timeout_s=0.0, backlash_deg=backlash_deg)
        self.wired = {
            joint.id: WireServo(joint, angles_rad[name], radians(backlash_deg)) for name, joint in joints.items()
        }
        self.servos.update({servo.joint.name: servo for servo in self.wired.values()})


class WireBase(MobileBase):
    """Wheels that turn as the Create's firmware asks, ramped as it does."""

    def __init__(self, base: Base) -> None:
        super().__init__(base, exact=True)
        self.asked_mps = (0.0, 0.0)
        self.counted_m = [0.0, 0.0]
        """What each wheel's encoder has counted since the start."""

    def rolled(self, left_m: float, right_m: float, now_ns: int, dt_s: float) -> None:
        self.counted_m = [self.counted_m[0] + left_m, self.counted_m[1] + right_m]

    def _obeyed(self, now_ns: int) -> tuple[float, float]:
        return self.asked_mps


class WireMotors:
    """Makes a world's motors, and keeps hold of them. Give `make` to the world."""

    base: WireBase
    servos: dict[int, WireServo]

    def make(self, robot: Robot, angles_rad: Mapping[str, float], realism: BodyRealism) -> Motors:
        networks: dict[str, ServoNetwork] = {}
        self.base = WireBase(robot.base)
        self.servos = {}
        for name in NETWORKS:
            joints = {joint: robot.joints[joint] for joint in robot.network_joints(name)}
            network = WireNetwork(joints, angles_rad, realism.backlash_deg)
            networks[name] = network
            self.servos |= network.wired
        return Motors(self.base, networks)
