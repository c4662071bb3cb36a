"""The declaration of the cockpit: see `cocoro.component`."""

from cocoro.component import Component
from cocoro.topics import (
    ARM_STATE,
    BASE_STATE,
    CANCEL,
    DETECTIONS,
    DRIVE,
    ESTOP,
    FLOOR_PLAN,
    FRAME,
    HEALTH,
    LATCH,
    OBJECTS,
    OFFSET,
    PLAN,
    RECORDING,
    RESET,
    RUN,
    TASK,
    TASKS,
)

COCKPIT = Component(
    name="cockpit",
    module="services.cockpit.service",
    doc="Shows the robot on a page in the browser, and takes stops and tasks from it.",
    reads=(FRAME, BASE_STATE, ARM_STATE, DETECTIONS, PLAN, FLOOR_PLAN, TASK, LATCH, HEALTH, OFFSET, RECORDING),
    calls=(RUN, CANCEL, DRIVE, OBJECTS, TASKS, ESTOP, RESET),
    optional=True,
    frames="reads",
    cpu_share=0.2,
    rss_mb=120.0,
    libraries=("starlette", "uvicorn", "websockets", "opencv-python-headless"),
    checks="services.cockpit.checks",
)
