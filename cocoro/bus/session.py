"""Opening and closing zenoh sessions without blocking the loop, and without a session outliving its interpreter."""

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
"""How long leaving the mesh may take before it is given up; the process can end all the same."""
LAST_TURN_S = 0.02
"""For threads of zenoh's that wait for the interpreter while the process ends."""
FRAGMENT_WAIT_US = 25_000
"""How long a large sample without shared memory may wait for a receiver on this machine that does not read."""

PACKETS = 16
"""May wait for the network in each priority, which is all that zenoh allows. An express sample is a packet by itself,
and a service publishes several at once: of zenoh's usual 2, a busy processor would lose some."""
ACCEPT_PENDING = 500
ACCEPT_MS = 3000
SHARED_MEMORY = "transport/shared_memory/enabled"
NO_SEGMENT = "shm segment"
"""In what zenoh says when it could not make one."""
SMALL_PRIORITIES = ("control", "real_time", "interactive_high", "interactive_low", "data_high", "data")


_SOURCE = re.compile(r" at /\S+\.rs:\d+\.?")
"""Where in zenoh an error arose; of no use to who reads it."""


def no_mesh(config: ZenohConfig) -> MeshError:
    if config.mode == "client":
        return MeshError(f"no mesh at {config.where}: no router answers there; start it, or put the [mesh] right")
    return MeshError(f"no mesh at {config.where}: start one with `cocoro up`")


def options(config: ZenohConfig, identity: str, listen: list[str], connect: list[str]) -> dict[str, Any]:
    """The options of a zenoh session by path. What is not said here is zenoh's default."""
    local = config.directory is not None
    patience_ms = round(config.patience_s * 1000)
    chosen: dict[str, Any] = {
        "id": identity,
        "mode": config.mode,
        "scouting/multicast/enabled": False,
        # Everyone connects to everyone, by the register or by the configured endpoints, and to nobody else.
        "scouting/gossip/enabled": False,
        # The longest that opening as a peer waits for its endpoints. A router would wait all of it, always.
        "scouting/delay": patience_ms if config.mode == "peer" else 0,
        # Zenoh's own wait for what the others declared now and then misses its end and takes all of the delay, so
        # the bus itself waits for their tokens, which come last; in a directory it knows whose.
        "open/return_conditions": {"connect_scouted": not local, "declares": False},
        "listen/endpoints": listen,
        "connect/endpoints": connect,
        "connect/timeout_ms": patience_ms if config.mode == "client" else -1,
        "connect/retry": {"period_init_ms": 20, "period_max_ms": 2000, "period_increase_factor": 2},
        # Who connects and says nothing takes one of so many places, for so long: of a thousand idle connections none
        # keeps a new session out for longer, and what they take is far from all that a process may have open.
        "transport/unicast/accept_pending": ACCEPT_PENDING,
        "transport/unicast/accept_timeout": ACCEPT_MS,
        "transport/link/tx/lease": round(config.lease_s * 1000),
        "transport/link/tx/queue/size": dict.fromkeys(SMALL_PRIORITIES, PACKETS),
        SHARED_MEMORY: config.shared_memory,
        # Frames have pools of their own (see `pool`).
        "transport/shared_memory/transport_optimization/enabled": False,
    }
    if local:
        chosen["transport/link/tx/queue/congestion_control/drop/max_wait_before_drop_fragments"] = FRAGMENT_WAIT_US
    return {**chosen, **config.options}


_UNASKED = "the process did not ask for it (`frames` of its row in the process table)"


class Opened(NamedTuple):
    """A session, and why it does without shared memory; empty when it has it."""

    session: zenoh.Session
    unshared: str

    def close(self) -> None:
        close_session(self.session)


def open_session(config: ZenohConfig, chosen: dict[str, Any]) -> Opened:
    """Blocks for at most the configuration's patience. MeshError, ConfigError.

    A session that is to have shared memory and cannot opens without, which is said in the log."""
    if not chosen[SHARED_MEMORY]:
        return Opened(_open(config, chosen), _UNASKED if not config.shared_memory else "the mesh's options say so")
    why = shared.obstacle(shared.SESSION_BYTES)
    if not why:
        try:
            return Opened(_open(config, chosen), "")
        except MeshError as error:  # others have filled it since
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
            what = "another process listens there already; end that one, or let the [mesh] say another place"
        raise MeshError(f"mesh of {config.name} at {', '.join(config.listen) or config.where}: {what}") from error


def close_session(session: zenoh.Session) -> None:
    session.close()  # type: ignore[no-untyped-call]


async def in_thread(work: Callable[[], T], undo: Callable[[T], None] | None = None) -> T:
    """Await work that blocks, in a daemon thread, so that it cannot keep the process from ending.
    Work that nobody waits for any more when it is done is undone."""
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


class ExitGuard:
    """Zenoh must not call back into an interpreter that is taken apart (`deploy.quit` tells why): sessions that the
    program forgot are closed before, and a thread of zenoh's that is about to call gets its turn. A program that
    would be sure ends by `quit_process`."""

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
            return  # a fork's sessions are its parent's
        threads = [threading.Thread(target=leave, daemon=True) for leave in list(self._leaves)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join(LEAVE_S)
        if self._used:
            time.sleep(LAST_TURN_S)
            shared.release()


exit_guard = ExitGuard()
