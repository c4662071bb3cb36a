"""The declaration of perception: see `cocoro.component`."""

from cocoro.component import Component
from cocoro.topics import ARM_STATE, DETECTIONS, FRAME, OBSTACLES

PERCEPTION = Component(
    name="perception",
    module="services.perception.service",
    doc="Finds the known objects in each frame.",
    reads=(FRAME, ARM_STATE),
    publishes=(DETECTIONS, OBSTACLES),
    needs=("kinect", "arm"),
    frames="reads",
    nice=5,
    cpu_share=0.5,
    rss_mb=250.0,
    libraries=("numpy", "opencv-python-headless"),
)
