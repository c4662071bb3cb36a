"""`cocoro`: the operator's command. The emergency stop takes a way of its own that imports next to nothing."""

from __future__ import annotations

import os
import sys
from typing import NoReturn

from cocoro.cli import exits
from cocoro.quit import quit_process

ESTOP = ("estop", "stop")


def main(arguments: list[str] | None = None) -> int:
    """Run a command; returns its exit code. A mistake of the operator's gets one line, no traceback."""
    arguments = sys.argv[1:] if arguments is None else arguments
    try:
        if arguments and arguments[0] in ESTOP:
            from cocoro.cli import estop

            return estop.main(arguments[0], arguments[1:])
        return _command(arguments)
    except KeyboardInterrupt:
        return exits.REFUSED
    except BrokenPipeError:  # the reader of our output has gone, as with `cocoro topics | head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return exits.FAILED


def _command(arguments: list[str]) -> int:
    from cocoro import errors
    from cocoro.cli.app import app

    try:
        app(args=arguments, prog_name="cocoro")
    except SystemExit as end:
        return end.code if isinstance(end.code, int) else exits.DONE if end.code is None else exits.FAILED
    except errors.CocoroError as error:
        print(f"cocoro: {error}", file=sys.stderr)
        return code_of(error)
    return exits.DONE


def code_of(error: Exception) -> int:
    """The exit code that stands for an error."""
    from cocoro import errors

    if isinstance(error, errors.MeshError):
        return exits.NO_MESH
    if isinstance(error, errors.ConfigError):
        return exits.USAGE
    if isinstance(error, errors.RefusedError):
        return exits.REFUSED
    return exits.FAILED


def run() -> NoReturn:
    """The process `cocoro`, to its end."""
    quit_process(main())


if __name__ == "__main__":
    run()
