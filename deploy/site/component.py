"""The declaration of the gateway: see `cocoro.component`."""

from dataclasses import replace

from cocoro.component import Component
from cocoro.topics import OFFSET, TIME

GATEWAY = Component(
    name="gateway",
    module="deploy.site.gateway",
    doc="Joins this host's share of a robot with the other hosts of its site, by certificates and access rules.",
    publishes=(OFFSET,),
    serves=(TIME,),
    calls=(TIME,),
    first=True,
    restart="always",
    backoff_s=0.1,
    nice=-5,
    cpu_share=0.2,
    rss_mb=120.0,
    libraries=("cryptography",),
)

PREFIX = f"{GATEWAY.name}-"


def gateway_of(host: str) -> Component:
    """The gateway of one host: each has a name of its own, since a robot has as many as it has hosts."""
    name = f"{PREFIX}{host}"
    return replace(GATEWAY, name=name, services=(name,), settings=GATEWAY.name)
