"""What can be wrong with a capture."""

from __future__ import annotations

from cocoro.errors import CocoroError, ConfigError


class CaptureError(CocoroError):
    """A capture cannot be read, or written; the text names the file."""


class NotAFileError(CaptureError, ConfigError):
    """Something else than a file was named: a pipe, a device."""


class DamageError(Exception):
    """Bytes that cannot be what they should be. Readers catch it and go on with what is whole."""


class CutOffError(DamageError):
    """There are fewer bytes than there should be, as where a recorder was killed in the middle of a record."""
