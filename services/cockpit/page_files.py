"""The files of the page, from this package. They are few and small, so they are read once and kept."""

from __future__ import annotations

import mimetypes
from functools import cached_property
from importlib import resources
from importlib.resources.abc import Traversable

from starlette.responses import PlainTextResponse, Response

INDEX = "index.html"
FOLDER = "page"
TYPES = {
    "css": "text/css",
    "html": "text/html",
    "js": "text/javascript",
    "json": "application/json",
    "svg": "image/svg+xml",
    "webmanifest": "application/manifest+json",
}
"""Types of contents that a machine's own table may not have."""
HEADERS = {"Cache-Control": "no-cache", "X-Content-Type-Options": "nosniff", "Referrer-Policy": "no-referrer"}


class PageFiles:
    """Gives the page's files by their names."""

    def response(self, name: str) -> Response:
        """A file with its type of content; for a name that is no file of the page, that it is not there."""
        content = self._contents.get(name)
        if content is None:
            return PlainTextResponse("there is no such file\n", 404)
        ending = name.rpartition(".")[2]
        kind = TYPES.get(ending) or mimetypes.guess_type(name)[0] or "application/octet-stream"
        return Response(content, media_type=kind, headers=HEADERS)

    @cached_property
    def _contents(self) -> dict[str, bytes]:
        found: dict[str, bytes] = {}
        _read(resources.files(__package__).joinpath(FOLDER), "", found)
        return found


def _read(folder: Traversable, prefix: str, found: dict[str, bytes]) -> None:
    for entry in folder.iterdir():
        if entry.is_dir():
            _read(entry, f"{prefix}{entry.name}/", found)
        else:
            found[prefix + entry.name] = entry.read_bytes()
