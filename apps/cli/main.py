"""`cocoro`: the operator's command. The emergency stop takes a way of its own that imports next to nothing.

However a command ends, it ends here, and in an exit code: with one line for what an operator can mend, and one for a
fault of the program's own.
"""

from __future__ import annotations

import errno
import os
import signal
import sys
import threading
from contextlib import suppress
from types import FrameType, TracebackType
from typing import TYPE_CHECKING, NoReturn

from apps.cli import exits, output
from deploy.quit import quit_process

if TYPE_CHECKING:
    from sys import UnraisableHookArgs

ESTOP = ("estop", "stop")
PACKAGES = ("apps", "cocoro", "services", "sim", "deploy")
ADVICE = {
    errno.ENOSPC: "make room there, or choose another place",
    errno.EDQUOT: "make room there, or choose another place",
    errno.EFBIG: "choose another place, or raise the limit (ulimit -f)",
    errno.EROFS: "choose another place",
    errno.EACCES: "choose another place, or have it allowed",
    errno.EPERM: "choose another place, or have it allowed",
    errno.ENAMETOOLONG: "choose a shorter name",
    errno.EMFILE: "raise the limit (ulimit -n)",
}


def main(arguments: list[str] | None = None) -> int:
    """Run a command; returns its exit code. A mistake of the operator's gets one line, no traceback."""
    arguments = sys.argv[1:] if arguments is None else arguments
    output.said_already.clear()
    try:
        if arguments and arguments[0] in ESTOP:
            from apps.cli import estop

            with output.going_on():
                return estop.main(arguments[0], arguments[1:])
        return _command(arguments)
    except BaseException as error:
        return failed(error)


def _command(arguments: list[str]) -> int:
    from typer.main import get_group

    from apps.cli import log_lines
    from apps.cli.app import app

    if output.taken_over():
        log_lines.take_over()
    try:
        get_group(app)(args=arguments, prog_name="cocoro")  # not app itself, which hooks itself into sys.excepthook
    except SystemExit as end:
        if _interrupted(end):  # the command line library has an exit code of its own for it
            return _cancelled()
        return end.code if isinstance(end.code, int) else exits.DONE if end.code is None else exits.FAILED
    return exits.DONE


def failed(error: BaseException) -> int:
    """Say what ended a command, in one line at most; the exit code for it."""
    from cocoro.errors import CocoroError

    while isinstance(error, BaseExceptionGroup) and len(error.exceptions) == 1:  # as a group of tasks wraps it
        error = error.exceptions[0]
    if isinstance(error, CocoroError):
        output.complain(str(error))
        return code_of(error)
    output.show_trace(error)
    if isinstance(error, output.OutputError):  # said at the end, when nothing more can get lost
        return exits.FAILED
    if isinstance(error, OSError):
        output.complain(_of_system(error))
        return exits.FAILED
    if _interrupted(error):
        return _cancelled()
    if isinstance(error, UnicodeEncodeError) and any("\udc80" <= c <= "\udcff" for c in error.object):
        output.complain(f"{error.object}: this is no UTF-8, which is needed here; choose another name")
        return exits.USAGE
    _say_bug(error)
    return exits.FAILED


def _cancelled() -> int:
    """End as cancelled. What was interrupted while it was made is taken apart now, and has nothing to say."""
    if output.taken_over():
        import warnings

        sys.unraisablehook = lambda found: output.show_trace(found.exc_value) if found.exc_value else None
        warnings.simplefilter("ignore")
    return exits.REFUSED


def _say_bug(error: BaseException) -> None:
    said = f"{output.named(error)}{_place(error)}"
    output.complain(f"internal error, please report it: {said}; {output.LEVEL}=debug shows the traceback")


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


def _of_system(error: OSError) -> str:
    """What the system has refused, where, and what to do about it."""
    if error.errno == errno.ENOENT and not _has_place():
        return "the current directory is gone; change to one that is there"
    names = [os.fsdecode(name) for name in (error.filename, error.filename2) if isinstance(name, str | bytes)]
    where = " to ".join(names) or (_full() if error.errno == errno.ENOSPC else "") or f"the system{_place(error)}"
    advice = ADVICE.get(error.errno or 0, f"{output.LEVEL}=debug shows the traceback")
    return f"{where}: {error.strerror or error or type(error).__name__}; {advice}"


def _full() -> str:
    """Which of the places that every command may write to is full: the system does not say that of a write."""
    import tempfile

    from cocoro.bus.endpoints import default_run_dir

    for place in (default_run_dir(), ".", tempfile.gettempdir()):
        with suppress(OSError):
            if not os.statvfs(place).f_bavail:
                return str(place)
    return ""


def _has_place() -> bool:
    """Whether there is a current directory."""
    try:
        os.getcwd()  # noqa: PTH109 # to ask costs no import
    except OSError:
        return False
    return True


def _interrupted(error: BaseException | None) -> bool:
    """Whether it came of Ctrl-C: libraries that are interrupted make errors of their own of it."""
    while error is not None and not isinstance(error, KeyboardInterrupt):
        error = error.__cause__ or error.__context__
    return error is not None


def _place(error: BaseException) -> str:
    """Where in this project an error was raised."""
    found, trace = "", error.__traceback__
    while trace is not None:
        name = str(trace.tb_frame.f_globals.get("__name__", ""))
        if name.partition(".")[0] in PACKAGES:
            found = f" (in {name}, line {trace.tb_lineno})"
        trace = trace.tb_next
    return found


# --- the process ----------------------------------------------------------------------------------


def run() -> NoReturn:
    """The process `cocoro`, to its end."""
    sys.excepthook = _leave
    sys.unraisablehook = _unraisable
    threading.excepthook = _of_thread
    for number in (signal.SIGTERM, signal.SIGHUP):
        if signal.getsignal(number) == signal.SIG_DFL:  # nohup's stays as it is
            signal.signal(number, _told)
    output.take_over()
    code = output.finish(main())
    signal.signal(signal.SIGINT, lambda *_: os._exit(code))  # all is done; who is in a hurry need not wait
    signal.signal(signal.SIGTERM, lambda *_: os._exit(code))
    quit_process(code)


def _told(_number: int, _frame: FrameType | None) -> None:
    """Being told to end, and a closed terminal, are as Ctrl-C, which every command knows how to end at."""
    if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:  # in the background of a script
        raise KeyboardInterrupt
    signal.raise_signal(signal.SIGINT)


def _leave(_kind: type[BaseException], error: BaseException, _trace: TracebackType | None) -> NoReturn:
    """Ctrl-C where nothing is under way any more, or yet: of all else there is nothing that `main` does not catch."""
    os._exit(output.finish(failed(error)))


def _unraisable(found: UnraisableHookArgs) -> None:
    """Ctrl-C that came in a destructor or the like, where Python drops it: again, a moment later."""
    if isinstance(found.exc_value, KeyboardInterrupt):
        import _thread

        _thread.start_new_thread(_thread.interrupt_main, ())
    elif found.exc_value is not None:
        output.show_trace(found.exc_value)
        _say_bug(found.exc_value)


def _of_thread(found: threading.ExceptHookArgs) -> None:
    """An error that ended a thread, and not the command."""
    if found.exc_value is not None:
        failed(found.exc_value)


if __name__ == "__main__":
    run()
