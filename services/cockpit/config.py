"""The cockpit's configuration: the `[service.cockpit]` table of a profile."""

from __future__ import annotations

from typing import Annotated

import msgspec
from msgspec import Meta


class CockpitConfig(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    host: str = "127.0.0.1"
    """The address of this machine at which the page is served; the default is reached from this machine alone."""
    port: Annotated[int, Meta(ge=0, le=65535)] = 8770
    """Where it is taken, the next free one of the `PORTS` after it; 0: any free one."""
    fps: Annotated[float, Meta(gt=0, le=60)] = 16.0
    """Pictures a second at most, for each viewer."""
    jpeg_quality: Annotated[int, Meta(ge=10, le=95)] = 75
    """Of the pictures for viewers whose network carries them; for others it is less."""
    folder: str | None = None
    """Folder of the captures, beside that of the recorder that is heard. Default: that of the recorder's default."""
    names: tuple[str, ...] = ()
    """Names and addresses under which other machines open the page, besides those of its certificate."""
    credentials: str = ""
    """Folder of `cocoro pki` with cert.pem, key.pem and ca.pem, for TLS."""
    tls_cert: str = ""
    """File of another certificate (PEM), with `tls_key`: of an authority that browsers know, say."""
    tls_key: str = ""
    """File of its private key (PEM), which nobody else may read."""
    site: str = ""
    """Folder of a site (site.toml, admitted.toml): its persons are let in by their certificates. Needs `credentials`,
    whose ca.pem verifies them."""
