"""What is logged where no log was set up: a line on standard error for each record, as commands say their faults."""

from __future__ import annotations

import logging

from apps.cli import output


def take_over() -> None:
    """Have Python's last resort for records be `LogLines`."""
    logging.lastResort = LogLines(logging.WARNING)


class LogLines(logging.Handler):
    """What libraries, callbacks and forgotten tasks have to say; the traceback with COCORO_LOG=debug."""

    def emit(self, record: logging.LogRecord) -> None:
        error = record.exc_info[1] if record.exc_info else None
        if isinstance(error, output.OutputError):  # said at the end
            return
        first = record.getMessage().partition("\n")[0]
        output.complain(first if error is None else f"{first}: {output.named(error)}")
        if error is not None:
            output.show_trace(error)
