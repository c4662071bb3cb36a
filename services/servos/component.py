"""The declaration of the servos: see `cocoro.component`."""

from dataclasses import replace

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

SERVOS_BASE = replace(
    SERVOS,
    name="servos-base",
    module="services.servos.mobile",
    doc="The servo groups, and the base of a robot whose wheels are turned by servos: neck and arm, hand, base.",
    services=("arm", "hand", "base"),
    reads=(*SERVOS.reads, topics.BASE_COMMAND),
    publishes=(*SERVOS.publishes, topics.BASE_STATE),
    serves=(*SERVOS.serves, topics.RECOVER),
    moves=("arm", "hand", "base"),
    settings="servos",
    cpu_share=0.35,
)
