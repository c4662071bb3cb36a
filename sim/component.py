"""The declaration of the simulator: see `cocoro.component`."""

from cocoro.component import Component
from cocoro.topics import (
    ARM_COMMAND,
    ARM_STATE,
    BASE_COMMAND,
    BASE_STATE,
    CLOCK,
    FRAME,
    HAND_COMMAND,
    HAND_STATE,
    LATCH,
    STOPS,
    TRUTH,
)

MOVES = ("base", "arm", "hand")

SIM = Component(
    name="sim",
    module="sim.service",
    doc="The simulated robot: stands in for all hardware services, key for key.",
    services=("kinect", *MOVES),
    reads=(BASE_COMMAND, ARM_COMMAND, HAND_COMMAND, LATCH),
    publishes=(FRAME, BASE_STATE, ARM_STATE, HAND_STATE, CLOCK, TRUTH),
    serves=tuple(request.of(service) for service in MOVES for request in STOPS),
    moves=MOVES,
    frames="publishes",
    start_s=60.0,
    cpu_share=1.0,
    rss_mb=600.0,
    libraries=("pybullet", "moderngl", "opencv-python-headless"),
)
