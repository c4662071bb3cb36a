"""The declaration of the simulator behind wires: see `cocoro.component`."""

from cocoro.component import Component
from cocoro.topics import CLOCK, FRAME, TRUTH

WIRE = Component(
    name="wire",
    module="sim.wire.service",
    doc="The simulated robot behind wires: the camera, and ports with base and servos at their other ends.",
    services=("kinect",),
    publishes=(FRAME, CLOCK, TRUTH),
    settings="sim",
    frames="publishes",
    start_s=60.0,
    cpu_share=1.0,
    rss_mb=600.0,
    libraries=("pybullet", "moderngl", "opencv-python-headless"),
)
