"""The declaration of the recorder: see `cocoro.component`."""

from cocoro.component import Component
from cocoro.topics import ABOUT, RECORDING

CAPTURE = Component(
    name="capture",
    module="services.capture.service",
    doc="Records the mesh into MCAP files.",
    publishes=(RECORDING,),
    calls=(ABOUT,),
    records=True,
    frames="reads",
    nice=10,
    cpu_share=0.3,
    rss_mb=300.0,
    libraries=("opencv-python-headless",),
)
