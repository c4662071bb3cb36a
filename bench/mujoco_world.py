"""The simulated robot and a scene's things in MuJoCo, from the same tables as the PyBullet world: to compare the time
of a physics step. Not used by the simulator."""

from __future__ import annotations

from collections.abc import Callable
from math import cos, sin
from typing import Any

from cocoro.robot import Robot
from sim.model import RobotModel, build_model
from sim.scene import Obstacle, Scene, SceneObject

GAIN_NM = 20.0
"""Torque of a motor per rad of its error, up to the servo's own torque."""
DAMPING = 0.5


def stepper(robot: Robot, scene: Scene, hz: int) -> Callable[[], None]:
    """A function that steps the scene with the robot at rest in its park pose by 1 / `hz` s, after it has settled.

    The links, masses, shapes and pairs that may collide are those of the URDF that PyBullet loads; the motors hold
    their joints; solver and contacts are MuJoCo's own, with its defaults. Raises ImportError without MuJoCo.
    """
    import mujoco

    model = build_model(robot)
    spec: Any = mujoco.MjSpec.from_string(_with_fixed_links(model.urdf))
    spec.option.timestep = 1.0 / hz
    spec.worldbody.first_body().add_freejoint()
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[10.0, 10.0, 0.1])
    _exclude(spec, model)
    for joint in spec.joints:
        if joint.type == mujoco.mjtJoint.mjJNT_HINGE:
            torque_nm = robot.joints[joint.name].torque_nm if joint.name in robot.joints else 1.0
            motor = spec.add_actuator(name=joint.name, target=joint.name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
            motor.set_to_position(kp=GAIN_NM, kv=DAMPING)
            motor.forcelimited, motor.forcerange = True, [-torque_nm, torque_nm]
    for item in scene.objects:
        _place(mujoco, spec, scene, item, item.yaw_rad if isinstance(item, Obstacle) else 0.0, item.mass_kg)
    for obstacle in scene.obstacles:
        _place(mujoco, spec, scene, obstacle, obstacle.yaw_rad, 0.0)
    compiled = spec.compile()
    data = mujoco.MjData(compiled)
    angles = dict.fromkeys(robot.joints, 0.0) | robot.poses["park"]
    for number in range(compiled.nu):
        joint = compiled.actuator(number).name
        data.ctrl[number] = data.joint(joint).qpos[0] = angles.get(joint, 0.0)
    for _ in range(hz):
        mujoco.mj_step(compiled, data)
    return lambda: mujoco.mj_step(compiled, data)


def _with_fixed_links(urdf: str) -> str:
    """The URDF, told to keep links without a joint of their own, as PyBullet does."""
    start = urdf.index(">", urdf.index("<robot")) + 1
    return f'{urdf[:start]}\n  <mujoco><compiler fusestatic="false"/></mujoco>{urdf[start:]}'


def _exclude(spec: Any, model: RobotModel) -> None:
    """Let the robot's links collide in the same pairs as in PyBullet."""
    allowed = {frozenset(pair) for pair in model.collision_pairs()}
    for number, one in enumerate(model.links):
        for other in model.links[number + 1 :]:
            if frozenset((one, other)) not in allowed:
                spec.add_exclude(bodyname1=one, bodyname2=other)


def _place(mujoco: Any, spec: Any, scene: Scene, item: SceneObject | Obstacle, yaw_rad: float, mass_kg: float) -> None:
    """Add a thing of the scene; without a mass it does not move."""
    half = (scene.robot.yaw_rad + yaw_rad) / 2
    body = spec.worldbody.add_body(pos=scene.to_world(item.centre_m), quat=[cos(half), 0.0, 0.0, sin(half)])
    sizes = item.dimensions_m
    kind = {
        "box": mujoco.mjtGeom.mjGEOM_BOX,
        "cylinder": mujoco.mjtGeom.mjGEOM_CYLINDER,
        "sphere": mujoco.mjtGeom.mjGEOM_SPHERE,
    }[item.shape]
    if item.shape == "cylinder":
        size = [sizes[0], sizes[1] / 2, 0.0]
    else:
        size = [side / 2 for side in sizes] if item.shape == "box" else [sizes[0], 0.0, 0.0]
    if mass_kg:
        body.add_freejoint()
        body.add_geom(type=kind, size=size, mass=mass_kg)
    else:
        body.add_geom(type=kind, size=size)
