"""The declarations of what carries frames from host to host: see `cocoro.component`. A site's plan adds them to the
shares of its hosts (`deploy.site.plan`); on one machine they do not run."""

from dataclasses import replace

from cocoro.component import Component
from cocoro.topics import FRAME, PACKED

PACKER = Component(
    name="packer",
    module="services.frames.packer",
    doc="Packs frames for other hosts and for persons, when they ask.",
    reads=(FRAME,),
    serves=(PACKED,),
    frames="reads",
    restart="always",
    cpu_share=0.2,
    rss_mb=150.0,
    libraries=("numpy", "opencv-python-headless"),
)
UNPACKER = Component(
    name="frames",
    module="services.frames.unpacker",
    doc="Fetches packed frames from another host, and publishes them on this one.",
    publishes=(FRAME,),
    calls=(PACKED,),
    frames="publishes",
    restart="always",
    cpu_share=0.2,
    rss_mb=150.0,
    libraries=("numpy", "opencv-python-headless"),
)

UNPACKER_PREFIX = f"{UNPACKER.name}-"


def unpacker_of(host: str) -> Component:
    """The unpacker of one host: each has a name of its own, since a robot has as many as it has hosts that read."""
    name = f"{UNPACKER_PREFIX}{host}"
    return replace(UNPACKER, name=name, services=(name,), settings=UNPACKER.name)
