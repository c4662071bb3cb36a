"""`cocoro`: the operator's command, from its arguments to its exit code.

`cocoro stop`, `cocoro --help`, and `cocoro status` without a robot take paths that import next to nothing; all other
commands are in `app`. An error becomes one line on standard error that says what failed, where, and what to do.
"""

from __future__ import annotations

import errno
import os
import signal
import sys
from contextlib import suppress

from apps.cli import exits, output
from deploy.quit import quit_process

TYPE_CHECKING = False
"""As in `typing`, which takes 2 ms to import."""
if TYPE_CHECKING:
    import threading
    from sys import UnraisableHookArgs
    from types import FrameType, TracebackType
    from typing import NoReturn

ESTOP = ("estop", "stop")
HELP: tuple[list[str], ...] = ([], ["--help"], ["-h"])
STATUS = (["status"], ["status", "--json"])
"""Arguments that are answered before the libraries of the other commands are imported."""
COMPLETES = "_COCORO_COMPLETE"
"""Environment variable by which a shell asks for the completion of a word."""
PACKAGES = ("apps", "cocoro", "services", "sim", "deploy")
ADVICE = {
    errno.ENOSPC: "make room there, or choose another place",
    errno.EDQUOT: "make room there, or choose another place",
    errno.EFBIG: "choose another place, or raise the limit (ulimit -f)",
    errno.EROFS: "choose another place",
    errno.EACCES: "choose another place, or get permission",
    errno.EPERM: "choose another place, or get permission",
    errno.ENAMETOOLONG: "choose a shorter name",
    errno.EMFILE: "raise the limit (ulimit -n)",
}


def main(arguments: list[str] | None = None) -> int:
    """Runs a command and returns its exit code. An operator's mistake gets one line and no traceback."""
    arguments = sys.argv[1:] if arguments is None else arguments
    output.recent_complaints.clear()
    output.told = False
    try:
        code = _run(arguments)
    except BaseException as error:
        output.told = False  # the error is printed after the results of before
        code = failed(error, arguments[0] if arguments else "")
    if code != exits.DONE and not output.told and output.asks_json(arguments):
        said = "; ".join(text.removeprefix("cocoro: ") for text in output.recent_complaints)
        output.print_json_error(code, said or ("cancelled" if code == exits.REFUSED else "no result"))
    return code


def _run(arguments: list[str]) -> int:
    if arguments and arguments[0] in ESTOP:
        from apps.cli import estop

        with output.going_on():
            return estop.main(arguments[0], arguments[1:])
    if arguments in HELP and COMPLETES not in os.environ:
        from apps.cli import help

        if (text := help.text()) is not None:
            print(text, end="\n" if arguments else "")  # as typer prints it
            return exits.DONE if arguments else exits.USAGE
    if arguments in STATUS:
        return _status("--json" in arguments)
    return _command(arguments)


def _status(as_json: bool) -> int:
    """The command without other options. That no robot is up is known before anything is imported that asks one; then
    MeshError is raised. The supervisor of the one that is up is asked before anything is imported that joins a mesh."""
    from deploy.rundir import START, robots

    up = robots()
    if not up and not os.environ.get("COCORO_SITE"):
        from cocoro.errors import MeshError

        raise MeshError(f"no robot is up on this machine: {START}")
    asked = None
    if len(up) == 1:
        from apps.cli.asked import Asked

        asked = Asked(up[0].survey_socket)
    from apps.cli.status import show_status, show_told  # while the supervisor collects what it tells

    if asked is not None and (code := show_told(asked, as_json)) is not None:
        return code
    import asyncio

    from apps.client.choice import RobotChoice

    _report_failures()
    return asyncio.run(show_status(RobotChoice(), as_json))


def _report_failures() -> None:
    """Has the failures of threads and what libraries log reported as a command's own."""
    import threading

    if output.taken_over():
        threading.excepthook = _thread_failed
        output.log_to_stderr()


def _command(arguments: list[str]) -> int:
    from typer.main import get_command

    from apps.cli.app import app

    _report_failures()
    try:
        get_command(app)(args=arguments, prog_name="cocoro")  # calling `app` would replace sys.excepthook
    except SystemExit as end:
        if _interrupted(end):  # typer has another exit code for it
            return _cancelled()
        said = getattr(end.__context__, "format_message", None)  # typer has printed what is wrong with the arguments
        if said is not None and output.asks_json(arguments):
            output.print_json_error(exits.USAGE, said())
        return end.code if isinstance(end.code, int) else exits.DONE if end.code is None else exits.FAILED
    return exits.DONE


def failed(error: BaseException, command: str = "") -> int:
    """Reports the error that ended a command in at most one line, and returns the exit code for it. `command` is the
    command's name."""
    from cocoro.errors import CocoroError

    while isinstance(error, BaseExceptionGroup) and len(error.exceptions) == 1:  # a TaskGroup wraps errors
        error = error.exceptions[0]
    if isinstance(error, CocoroError):
        output.complain(str(error))
        return code_of(error)
    output.show_trace(error)
    if isinstance(error, output.OutputError):  # `finish` reports it
        return exits.FAILED
    if isinstance(error, OSError):
        output.complain(_system_error(error))
        return exits.FAILED
    if _interrupted(error):
        return _cancelled()
    if isinstance(error, UnicodeEncodeError) and any("\udc80" <= c <= "\udcff" for c in error.object):
        output.complain(f"{error.object}: this name is not valid UTF-8; choose another name")
        return exits.USAGE
    hiding = _hiding(error) if isinstance(error, ImportError) else ""
    if hiding:
        output.complain(hiding)
        return exits.USAGE
    if isinstance(error, ModuleNotFoundError):
        from deploy.extras import advice_of

        if sentence := advice_of(error, command):
            output.complain(sentence)
            return exits.USAGE
    _report_bug(error)
    return exits.FAILED


def _hiding(error: ImportError) -> str:
    """Text for a failed import of this project's own code because a foreign package of the same name comes first on
    Python's search path; '' for any other failed import."""
    name = (error.name or "").partition(".")[0]
    own = os.path.dirname(os.path.dirname(os.path.dirname(os.path.abspath(__file__))))  # noqa: PTH120, PTH100
    package = sys.modules.get(name)
    folders = [os.path.dirname(os.path.abspath(path)) for path in getattr(package, "__path__", ())]  # noqa: PTH120, PTH100
    if name not in PACKAGES or not folders or own in folders:
        return ""
    return (
        f"the package {name!r} in {folders[0]} hides this project's package of that name; remove {folders[0]} from "
        f"PYTHONPATH, or install cocoro-mesh into an environment of its own"
    )


def _cancelled() -> int:
    """The exit code of a cancelled command. Silences what half-made objects report while they are destroyed."""
    if output.taken_over():
        import warnings

        sys.unraisablehook = lambda found: output.show_trace(found.exc_value) if found.exc_value else None
        warnings.simplefilter("ignore")
    return exits.REFUSED


def _report_bug(error: BaseException) -> None:
    text = f"{output.named(error)}{_place(error)}"
    output.complain(f"internal error, please report it: {text}; {output.LEVEL}=debug shows the traceback")


def code_of(error: Exception) -> int:
    """The exit code for an error."""
    from cocoro import errors

    if isinstance(error, errors.MeshError):
        return exits.NO_MESH
    if isinstance(error, errors.ConfigError):
        return exits.USAGE
    if isinstance(error, errors.RefusedError):
        return exits.REFUSED
    return exits.FAILED


def _system_error(error: OSError) -> str:
    """Text for an error of the operating system: where, what, and what to do."""
    if error.errno == errno.ENOENT and not _has_directory():
        return "the current directory has been removed; change to another one"
    names = [os.fsdecode(name) for name in (error.filename, error.filename2) if isinstance(name, str | bytes)]
    where = " to ".join(names) or (_full() if error.errno == errno.ENOSPC else "") or f"the system{_place(error)}"
    advice = ADVICE.get(error.errno or 0, f"{output.LEVEL}=debug shows the traceback")
    return f"{where}: {error.strerror or error or type(error).__name__}; {advice}"


def _full() -> str:
    """A directory of those that commands write to whose disk is full; a failed write does not name its file."""
    import tempfile

    from cocoro.private import default_run_dir

    for place in (default_run_dir(), ".", tempfile.gettempdir()):
        with suppress(OSError):
            if not os.statvfs(place).f_bavail:
                return str(place)
    return ""


def _has_directory() -> bool:
    """Whether the current directory exists."""
    try:
        os.getcwd()  # noqa: PTH109 # needs no import
    except OSError:
        return False
    return True


def _interrupted(error: BaseException | None) -> bool:
    """Whether Ctrl-C caused the error; libraries wrap a KeyboardInterrupt in errors of their own."""
    while error is not None and not isinstance(error, KeyboardInterrupt):
        error = error.__cause__ or error.__context__
    return error is not None


def _place(error: BaseException) -> str:
    """The module and line of this project that raised the error, as text; empty when none did."""
    found, trace = "", error.__traceback__
    while trace is not None:
        name = str(trace.tb_frame.f_globals.get("__name__", ""))
        if name.partition(".")[0] in PACKAGES:
            found = f" (in {name}, line {trace.tb_lineno})"
        trace = trace.tb_next
    return found


# --- the process ----------------------------------------------------------------------------------


def run() -> NoReturn:
    """The process `cocoro`: runs the command and ends the process with its exit code."""
    sys.excepthook = _leave
    sys.unraisablehook = _unraisable
    for number in (signal.SIGTERM, signal.SIGHUP):
        if signal.getsignal(number) == signal.SIG_DFL:  # nohup's SIG_IGN stays
            signal.signal(number, _as_interrupt)
    output.take_over()
    code = output.finish(main())
    signal.signal(signal.SIGINT, lambda *_: os._exit(code))  # the command is done; Ctrl-C skips the clean-up
    signal.signal(signal.SIGTERM, lambda *_: os._exit(code))
    quit_process(code)


def _as_interrupt(_number: int, _frame: FrameType | None) -> None:
    """Handles SIGTERM and SIGHUP as Ctrl-C, which every command handles."""
    if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:  # a script runs the command in the background
        raise KeyboardInterrupt
    signal.raise_signal(signal.SIGINT)


def _leave(_kind: type[BaseException], error: BaseException, _trace: TracebackType | None) -> NoReturn:
    """Handles Ctrl-C outside of `main`, which catches everything else."""
    os._exit(output.finish(failed(error)))


def _unraisable(found: UnraisableHookArgs) -> None:
    """Repeats a Ctrl-C that came in a destructor, where Python would drop it; reports other errors as bugs."""
    if isinstance(found.exc_value, KeyboardInterrupt):
        import _thread

        _thread.start_new_thread(_thread.interrupt_main, ())
    elif found.exc_value is not None:
        output.show_trace(found.exc_value)
        _report_bug(found.exc_value)


def _thread_failed(found: threading.ExceptHookArgs) -> None:
    """Reports an error that ended a thread but not the command."""
    if found.exc_value is not None:
        failed(found.exc_value)


if __name__ == "__main__":
    run()
