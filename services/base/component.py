"""The declaration of the base: see `cocoro.component`."""

from cocoro.component import Component
from cocoro.topics import BASE_COMMAND, BASE_STATE, LATCH, RECOVER, STOPS

BASE = Component(
    name="base",
    module="services.base.service",
    doc="The Create: wheels, bumpers, cliffs, battery. Small, because a Create keeps driving when its driver dies.",
    reads=(BASE_COMMAND, LATCH),
    publishes=(BASE_STATE,),
    serves=(RECOVER, *STOPS),
    moves=("base",),
    hardware=True,
    restart="always",
    backoff_s=0.1,
    nice=-10,
    cpu_share=0.15,
    libraries=("pyserial",),
    checks="services.base.doctor",
)
