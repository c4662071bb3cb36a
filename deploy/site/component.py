"""The declaration of the gateway: see `cocoro.component`."""

from cocoro.component import Component

GATEWAY = Component(
    name="gateway",
    module="deploy.site.gateway",
    doc="Joins this host's share of a robot with the other hosts of its site, by certificates and access rules.",
    restart="always",
    backoff_s=0.1,
    nice=-5,
    cpu_share=0.2,
    rss_mb=120.0,
    libraries=("cryptography",),
)
