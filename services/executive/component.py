"""The declaration of the executive: see `cocoro.component`."""

from cocoro.component import Component
from cocoro.topics import (
    ARM_STATE,
    BASE_STATE,
    CANCEL,
    DRIVE,
    HAND_STATE,
    HEALTH,
    INTENT,
    LATCH,
    OBJECTS,
    PLAN,
    REPORT,
    RUN,
    STOPS,
    TASK,
    TASKS,
)

EXECUTIVE = Component(
    name="executive",
    module="services.executive.service",
    doc="Runs the tasks: fetch, park, put-down; keeps the emergency stop's latch.",
    reads=(BASE_STATE, ARM_STATE, HAND_STATE, PLAN, HEALTH),
    publishes=(INTENT, TASK, LATCH),
    serves=(RUN, CANCEL, DRIVE, REPORT, OBJECTS, TASKS, *STOPS),
    needs=("base", "arm", "hand", "planning"),
    cpu_share=0.2,
)
