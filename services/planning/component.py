"""The declaration of the planner: see `cocoro.component`."""

from cocoro.component import Component
from cocoro.topics import (
    ARM_COMMAND,
    ARM_STATE,
    BASE_COMMAND,
    BASE_STATE,
    DETECTIONS,
    FLOOR_PLAN,
    HAND_COMMAND,
    HAND_SAMPLES,
    HAND_STATE,
    INTENT,
    LEARNED,
    MODEL,
    OBSTACLES,
    PLAN,
    POLICY_ACTIONS,
    WHEEL_TRIALS,
)

PLANNING = Component(
    name="planning",
    module="services.planning.service",
    doc="Turns intent and the latest state into head, wheel, arm and hand commands, 50 times a second.",
    reads=(INTENT, BASE_STATE, ARM_STATE, HAND_STATE, DETECTIONS, OBSTACLES, MODEL, POLICY_ACTIONS),
    publishes=(BASE_COMMAND, ARM_COMMAND, HAND_COMMAND, PLAN, FLOOR_PLAN, HAND_SAMPLES, WHEEL_TRIALS, MODEL),
    serves=(LEARNED,),
    needs=("base", "arm", "hand", "perception"),
    cpu_share=0.4,
    rss_mb=200.0,
    imports_later=("scipy.sparse.csgraph",),  # the first detour: 0.2 s, in which the base's command would expire
    libraries=("numpy", "scipy", "opencv-python-headless"),
)
