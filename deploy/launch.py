"""Runs one process of the table: `python -m deploy.launch PROCESS --run-dir DIR`, or `run` from one's own terminal.

Exit codes: 0 it was asked to end, 1 it crashed (traceback in the log), 2 an error that its user can correct, 3
something that runs already keeps it from starting (for both one line in the log).
"""

from __future__ import annotations

import argparse
import asyncio
import faulthandler
import json
import logging
import os
import signal
import threading
import time
from collections.abc import Awaitable, Sequence
from contextlib import suppress
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

import msgspec

from cocoro import private
from cocoro.errors import CocoroError, RefusedError
from cocoro.heap import keep_freed
from cocoro.lending import LendingLoop
from deploy.quit import quit_process
from deploy.rundir import RunDir

OK, CRASHED, MISCONFIGURED, REFUSED = 0, 1, 2, 3
ORPHAN_S = 5.0
"""Time within which a process ends after its supervisor has died."""
SETTLED_S = 3.0
"""So long after the start of a process those that were started with it have started, too."""
LEVEL = "COCORO_LOG"
"""Environment variable with the log level; info when it is not set."""


class Line(logging.Formatter):
    """One line per record: time, level, process, message."""

    def __init__(self, process: str) -> None:
        super().__init__(f"%(asctime)s.%(msecs)03d %(levelname)-7s {process}: %(message)s", "%Y-%m-%dT%H:%M:%S")

    def formatMessage(self, record: logging.LogRecord) -> str:  # noqa: N802 # the library's name
        return super().formatMessage(record).replace("\n", " | ")


def set_up_logging(process: str) -> logging.Logger:
    handler = logging.StreamHandler()
    handler.setFormatter(Line(process))
    logging.basicConfig(handlers=[handler], level=os.environ.get(LEVEL, "info").upper(), force=True)
    logging.captureWarnings(True)
    return logging.getLogger(f"cocoro.{process}")


def changed(config: Any, path: str = "") -> list[str]:
    """The settings that differ from their defaults, as `head.sweep_speed_radps = 0.5`; all of them would be 2 KB."""
    found = []
    for field in msgspec.structs.fields(config):
        value = getattr(config, field.name)
        default = field.default_factory() if field.default_factory is not msgspec.NODEFAULT else field.default
        if isinstance(value, msgspec.Struct) and type(value) is type(default):
            found += changed(value, f"{path}{field.name}.")
        elif value != default:
            found.append(f"{path}{field.name} = {json.dumps(value, default=str)}")
    return found


def watch_parent(fd: int) -> None:
    """Ends this process when the other end of a pipe is closed: the supervisor has died.

    A thread does it, so that it works while modules are imported and when the event loop hangs.
    """

    def watch() -> None:
        while os.read(fd, 1):
            pass
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(ORPHAN_S)
        os._exit(CRASHED)

    threading.Thread(target=watch, name="parent", daemon=True).start()


def run(
    process: str,
    run_dir: RunDir,
    profile: dict[str, Any],
    profile_name: str,
    *,
    raise_crashes: bool = False,
    beat_fd: int | None = None,
) -> int:
    """Runs a process until a signal ends it; returns the exit code. Logging must be set up. A crash is logged with its
    traceback, or raised (`raise_crashes`) for a caller that reports it. A supervisor sees by `beat_fd` that the process
    does not hang (`deploy.heartbeat`)."""
    log = logging.getLogger(f"cocoro.{process}")
    keep_freed()
    try:
        with asyncio.Runner(loop_factory=LendingLoop) as runner:
            return runner.run(_main(process, run_dir, profile, profile_name, beat_fd))
    except CocoroError as error:
        log.error("%s", error)
        return REFUSED if isinstance(error, RefusedError) else MISCONFIGURED
    except KeyboardInterrupt:
        return OK
    except OSError as error:
        if not private.full(error):
            log.exception("crashed")
            return CRASHED
        log.error("%s: %s; make room there", error.filename or run_dir.path, error.strerror)
        return MISCONFIGURED
    except Exception as error:
        from deploy.extras import advice_of

        if sentence := advice_of(error):
            log.error("%s", sentence)
            return MISCONFIGURED
        if raise_crashes:
            raise
        log.exception("crashed")
        return CRASHED


async def _main(
    process: str, run_dir: RunDir, data: dict[str, Any], profile_name: str, beat_fd: int | None = None
) -> int:
    from cocoro.bus.session import receive_in_one_thread
    from cocoro.bus.zenoh import ZenohBus
    from cocoro.clock import FollowedClock
    from cocoro.component import load as load_component
    from cocoro.robot import Robot
    from cocoro.stop.record import latch_dir
    from deploy import processes, profiles, robot_time
    from deploy.contact import ProcessContact, SleepDetector
    from deploy.delayed import DelayedNode
    from deploy.heartbeat import beat

    profile = profiles.from_data(data, profile_name)
    row = processes.named(process)
    claims = run_dir.claim(process, row.services)
    try:
        with suppress(PermissionError):  # a negative value is a privilege
            os.nice(row.nice)
        if row.records:
            receive_in_one_thread()
        component = load_component(row)
        config = profile.config(process, component.config)
        launch = profile.launch(process)
        robot = Robot.load(_path(profile.description), _path(profile.measured))
        log = logging.getLogger(f"cocoro.{process}")
        log.info("%s with %s", row.module, "; ".join(changed(config)) or "the default settings")
        stop = _stop_signal()
        # Without a supervisor, the first process fixes the robot's time for those that come later.
        real_clock = robot_time.clock if run_dir.populated else robot_time.fix
        async with (
            await ZenohBus.open(run_dir.join_as(process, profile.mesh, frames=bool(row.frames))) as bus,
            DelayedNode(
                process,
                bus,
                FollowedClock() if profile.clock == "sim" else real_clock(run_dir.path),
                robot,
                robot_name=profile.robot,
                latency_s=launch.latency_s,
                record_steps=launch.record_steps,
                module=row.module,
                config=config,
                profile=data,
                latches=latch_dir(profile.robot),
                contact=ProcessContact(run_dir.claimant_pid, SleepDetector(log.warning)),
            ) as node,
        ):
            log.info("joined the mesh at %s", bus.where)
            if beat_fd is not None:
                node.spawn(beat(beat_fd))
            if row.imports_later:
                node.spawn(_import_later(row.imports_later))
            if await _until(stop, component.run(node, config)):
                log.info("ended by a signal")
                return OK
        log.error("ended by itself, though a component runs for ever")
        return CRASHED
    finally:
        for claim in claims:
            claim.release()


def _path(file: str | None) -> Path | None:
    return None if file is None else Path(file)


async def _import_later(modules: Sequence[str]) -> None:
    """When the robot's other processes have started, and in a thread, so that this one goes on."""
    from cocoro.bus.session import in_thread

    await asyncio.sleep(SETTLED_S)
    for module in modules:
        await in_thread(partial(import_module, module))


def _stop_signal() -> asyncio.Event:
    """An event that the first SIGTERM or SIGINT sets; a second one has its default effect."""
    loop, stop = asyncio.get_running_loop(), asyncio.Event()
    before = {number: signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGINT)}

    def on_signal() -> None:
        stop.set()
        for number, handler in before.items():
            loop.remove_signal_handler(number)
            signal.signal(number, handler)

    for number in before:
        loop.add_signal_handler(number, on_signal)
    return stop


async def _until(stop: asyncio.Event, work: Awaitable[None]) -> bool:
    """Runs the work until its end or until `stop` is set, which cancels it; returns whether it was. Raises the work's
    errors."""
    working, stopping = asyncio.ensure_future(work), asyncio.ensure_future(stop.wait())
    await asyncio.wait((working, stopping), return_when=asyncio.FIRST_COMPLETED)
    stopping.cancel()
    if working.done():
        working.result()
        return False
    working.cancel()
    with suppress(asyncio.CancelledError):
        await working
    return True


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m deploy.launch", description="Run one process of a robot.")
    parser.add_argument("process")
    parser.add_argument("--run-dir", type=Path, required=True, help="the robot's folder, with its profile.json")
    parser.add_argument("--parent-fd", type=int, help="a pipe that closes when the supervisor dies")
    parser.add_argument("--beat-fd", type=int, help="a file in which the event loop counts, so that a hang is seen")
    options = parser.parse_args(arguments)
    faulthandler.enable()
    set_up_logging(options.process)
    if options.parent_fd is not None:
        watch_parent(options.parent_fd)
    folder: Path = options.run_dir
    run_dir = RunDir(folder.name, folder.parent)
    profile = run_dir.resolved()
    return run(options.process, run_dir, profile, profile.get("name", ""), beat_fd=options.beat_fd)


if __name__ == "__main__":
    quit_process(main())
