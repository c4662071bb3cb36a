"""Opens and closes zenoh sessions without blocking the event loop, and closes them before the interpreter ends."""

from __future__ import annotations

import asyncio
import atexit
import contextlib
import json
import logging
import os
import re
import threading
import time
from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar, cast

import zenoh

from cocoro.bus import shared
from cocoro.bus.endpoints import ZenohConfig
from cocoro.errors import ConfigError, MeshError

log = logging.getLogger(__name__)
T = TypeVar("T")

LEAVE_S = 2.0
"""Longest wait for leaving the mesh; the process can end without it."""
LAST_TURN_S = 0.02
"""Time that zenoh's threads get to return from callbacks when the process ends."""
FRAGMENT_WAIT_US = 25_000
"""Longest wait of a large sample without shared memory for a receiver on this machine that does not read."""

PACKETS = 16
"""Packets that may wait for the network, per priority; zenoh's maximum. Each express sample is a packet, and a service
publishes several together: with zenoh's default of 2, a busy machine would lose some."""
ACCEPT_PENDING = 500
ACCEPT_MS = 3000
SHARED_MEMORY = "transport/shared_memory/enabled"
NO_SEGMENT = "shm segment"
"""Part of zenoh's error when it could not make a segment."""
SMALL_PRIORITIES = ("control", "real_time", "interactive_high", "interactive_low", "data_high", "data")


_SOURCE = re.compile(r" at /\S+\.rs:\d+\.?")
"""The place in zenoh's source at the end of its errors."""


def no_mesh(config: ZenohConfig) -> MeshError:
    if config.mode == "client":
        return MeshError(f"no mesh at {config.where}: no router answers there: is it up, and is the network?")
    return MeshError(f"no mesh at {config.where}: start one with `cocoro up`")


def options(config: ZenohConfig, identity: str, listen: list[str], connect: list[str]) -> dict[str, Any]:
    """The options of a zenoh session, by path; all others have zenoh's defaults."""
    local = config.directory is not None
    patience_ms = round(config.patience_s * 1000)
    chosen: dict[str, Any] = {
        "id": identity,
        "mode": config.mode,
        "scouting/multicast/enabled": False,
        # Connections are made by the register or the configured endpoints, and no others.
        "scouting/gossip/enabled": False,
        # Longest wait of a peer for its endpoints. A router would always wait for all of it.
        "scouting/delay": patience_ms if config.mode == "peer" else 0,
        # Zenoh's own wait for the others' declarations sometimes misses the last one and takes all of the delay. The
        # bus instead waits for the members' tokens, which are declared last (`ZenohBus._settle`).
        "open/return_conditions": {"connect_scouted": not local, "declares": False},
        "listen/endpoints": listen,
        "connect/endpoints": connect,
        "connect/timeout_ms": patience_ms if config.mode == "client" else -1,
        "connect/retry": {"period_init_ms": 20, "period_max_ms": 2000, "period_increase_factor": 2},
        # An idle connection takes one of ACCEPT_PENDING places for at most ACCEPT_MS, so idle connections delay a new
        # session by no more, and their sockets are far fewer than a process may have open.
        "transport/unicast/accept_pending": ACCEPT_PENDING,
        "transport/unicast/accept_timeout": ACCEPT_MS,
        "transport/link/tx/lease": round(config.lease_s * 1000),
        "transport/link/tx/queue/size": dict.fromkeys(SMALL_PRIORITIES, PACKETS),
        SHARED_MEMORY: config.shared_memory,
        # Each publisher of frames has its own pool (`declared.SharedPool`).
        "transport/shared_memory/transport_optimization/enabled": False,
    }
    if local:
        chosen["transport/link/tx/queue/congestion_control/drop/max_wait_before_drop_fragments"] = FRAGMENT_WAIT_US
    return {**chosen, **config.options}


_UNASKED = "the process did not ask for it (`frames` of its component)"


class Opened(NamedTuple):
    """A session, and why it has no shared memory; empty when it has."""

    session: zenoh.Session
    unshared: str

    def close(self) -> None:
        close_session(self.session)


def open_session(config: ZenohConfig, chosen: dict[str, Any]) -> Opened:
    """Opens a session; blocks for at most `patience_s`. Raises MeshError, ConfigError.

    When shared memory is asked for and cannot be had, the session opens without it, and a warning is logged."""
    if not chosen[SHARED_MEMORY]:
        return Opened(_open(config, chosen), _UNASKED if not config.shared_memory else "the mesh's options say so")
    why = shared.obstacle(shared.SESSION_BYTES)
    if not why:
        try:
            return Opened(_open(config, chosen), "")
        except MeshError as error:  # other processes have filled it since
            if NO_SEGMENT not in f"{error} {error.__cause__}":
                raise
            shared.drop_failed()
            why = shared.obstacle(shared.SESSION_BYTES) or str(error)
    log.warning("no shared memory: %s; %s", why, shared.COSTS)
    return Opened(_open(config, chosen | {SHARED_MEMORY: False}), why)


def _open(config: ZenohConfig, chosen: dict[str, Any]) -> zenoh.Session:
    settings = zenoh.Config()
    for path, value in chosen.items():
        try:
            settings.insert_json5(path, json.dumps(value))
        except zenoh.ZError as error:
            raise ConfigError(f"mesh of {config.name}: option {path} = {value!r}: {error}") from error
    try:
        return zenoh.open(settings)
    except zenoh.ZError as error:
        if config.mode == "client":
            raise no_mesh(config) from error
        what = _SOURCE.sub("", str(error))
        if "Address already in use" in what:
            what = "another process listens there already; end that one, or choose another endpoint"
        raise MeshError(f"mesh of {config.name} at {', '.join(config.listen) or config.where}: {what}") from error


def close_session(session: zenoh.Session) -> None:
    session.close()  # type: ignore[no-untyped-call]


async def in_thread(work: Callable[[], T], undo: Callable[[T], None] | None = None) -> T:
    """Runs blocking work in a daemon thread, which cannot keep the process from ending, and returns its result. If the
    caller was cancelled meanwhile, `undo` is called with the result."""
    loop = asyncio.get_running_loop()
    future: asyncio.Future[T] = loop.create_future()

    def hand_over(result: T | None, error: BaseException | None) -> None:
        if future.cancelled():
            if error is None and undo is not None:
                undo(cast(T, result))
        elif error is not None:
            future.set_exception(error)
        else:
            future.set_result(cast(T, result))

    def run() -> None:
        result: T | None = None
        error: BaseException | None = None
        try:
            result = work()
        except BaseException as raised:
            error = raised
        with contextlib.suppress(RuntimeError):  # the loop has been closed
            loop.call_soon_threadsafe(hand_over, result, error)

    threading.Thread(target=run, name="mesh", daemon=True).start()
    return await future


_THREADS, _ONE_RECEIVES = "ZENOH_RUNTIME", "(rx: (worker_threads: 1))"
"""Environment variable with the threads of zenoh, which it reads when the first session of a process opens."""


def receive_in_one_thread() -> None:
    """Has zenoh receive in one thread of this process, instead of two that wake one another for most messages. For a
    process that only listens to many small messages; to be called before its first session."""
    os.environ.setdefault(_THREADS, _ONE_RECEIVES)


class ExitGuard:
    """Closes forgotten sessions before the interpreter is finalized, and lets zenoh's threads return from callbacks:
    zenoh must not call back into an interpreter that is being finalized (see `deploy.quit`). Only a program that ends
    by `quit_process` is safe from that in all cases."""

    def __init__(self) -> None:
        self._leaves: set[Callable[[], None]] = set()
        self._used = False
        self._process = os.getpid()
        atexit.register(self._leave_all)

    def add(self, leave: Callable[[], None]) -> None:
        self._leaves.add(leave)
        self._used = True

    def discard(self, leave: Callable[[], None]) -> None:
        self._leaves.discard(leave)

    def _leave_all(self) -> None:
        if os.getpid() != self._process:
            return  # the sessions of a forked process belong to its parent
        threads = [threading.Thread(target=leave, daemon=True) for leave in list(self._leaves)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join(LEAVE_S)
        if self._used:
            time.sleep(LAST_TURN_S)
            shared.release()


exit_guard = ExitGuard()
