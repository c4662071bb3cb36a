"""The declaration of the Kinect: see `cocoro.component`."""

from cocoro.component import Component
from cocoro.topics import FRAME

KINECT = Component(
    name="kinect",
    module="services.kinect.service",
    doc="The Kinect, or another camera: colour, and depth where it has any.",
    publishes=(FRAME,),
    hardware=True,
    frames="publishes",
    restart="always",
    cpu_share=0.3,
    rss_mb=200.0,
    libraries=("numpy", "opencv-python-headless"),
    checks="services.kinect.doctor",
)
