"""The errors that a user can cause or must know of; the CLI shows their text and no traceback."""


class CocoroError(Exception):
    """What went wrong, where, and what to do about it, in one sentence or two."""


class ConfigError(CocoroError):
    """A file or an option has a wrong value; the text names the file and the field."""


class MeshError(CocoroError):
    """The mesh, or the service that is asked, is not there."""


class CallTimeoutError(MeshError):
    """Nobody answered a request in time."""


class RemoteError(CocoroError):
    """The service that was asked answered with an error; the text is the service's own."""


class RefusedError(CocoroError):
    """What was asked cannot be now, because of something that is there already; the text says what."""
