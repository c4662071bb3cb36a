"""The declaration of the servos: see `cocoro.component`."""

from cocoro import topics
from cocoro.component import Component

SERVOS = Component(
    name="servos",
    module="services.servos.service",
    doc="The servo groups: neck and arm, hand.",
    services=("arm", "hand"),
    reads=(topics.ARM_COMMAND, topics.HAND_COMMAND, topics.LATCH),
    publishes=(topics.ARM_STATE, topics.HAND_STATE),
    serves=(topics.SERVOS, *topics.STOPS),
    moves=("arm", "hand"),
    hardware=True,
    restart="always",
    backoff_s=0.1,
    nice=-10,
    cpu_share=0.25,
    libraries=("pyserial", "dynamixel-sdk"),
    checks="services.servos.doctor",
)
