"""Receives everything on one robot's mesh and hands it to a sink, with liveliness, configurations and wall-clock
steps."""

from __future__ import annotations

import asyncio
import base64
import json
import platform
from collections import deque
from contextlib import suppress
from datetime import UTC, datetime
from typing import Any

import msgspec

from cocoro.about import versions
from cocoro.bus.base import Handle, Payload, Received
from cocoro.capture.occasion import Occasion
from cocoro.capture.types import Alive, MessageHead
from cocoro.clock import NS, Clock
from cocoro.errors import MeshError, RemoteError
from cocoro.installed import topic_named, unrecorded
from cocoro.keys import alive_key, recorder_key
from cocoro.messages import AboutReply, AboutRequest, ClockTick, DisturbedFile, Recording
from cocoro.node import Node
from cocoro.stream_checks import ANY_HZ, SequenceTracker
from cocoro.topics import ABOUT, CLOCK, RECORDING
from services.capture.keys import ALIVE_INFO, KeyFilter, KeyInfo, QueuedMessage
from services.capture.log_clock import WALL_CLOCK, LogClock, describe_step
from services.capture.occasions import OccasionNews, Watch
from services.capture.sink import RecordingProgress, RecordingSink
from services.capture.writer import Missing, describe_disturbance

REPORT_S = 1.0
"""Period of the progress messages."""
TRIES, RETRY_S = 10, 1.0
"""How often a service is asked for its configuration, and the pause before the next try."""
GROWTH_S = 60.0
POLL_S = 0.1
"""Period of the checks for new faults and for steps of the wall clock."""


class KeyCounts:
    """Messages of one key that arrived, were lost on the way, or were dropped."""

    def __init__(self, rate_hz: float) -> None:
        """`rate_hz` is the nominal rate; a jump of sequence numbers is judged by it."""
        self.arrived = 0
        self.dropped = 0
        self._rate_hz = rate_hz
        self._source = SequenceTracker()

    @property
    def lost(self) -> int:
        return self._source.gaps

    def count(self, head: MessageHead) -> bool:
        """Count a message. Returns whether its sequence number is plausible by the rules of `cocoro.stream_checks`;
        the gap before an implausible number is no loss."""
        self.arrived += 1
        source = self._source
        if head.incarnation != source.incarnation:
            source.begin(head.incarnation)
        elif head.seq != source.seq + 1:
            lost = source.jump(head.seq, head.stamp_ns, self._rate_hz, None)
            if lost is None:
                return False
            source.gaps += lost
        source.seq, source.stamp_ns = head.seq, head.stamp_ns
        if source.troubled:
            source.settle()
        return True


def counts_of(key: str, robot: str) -> KeyCounts:
    topic = topic_named(key.removeprefix(f"{robot}/"))
    return KeyCounts(ANY_HZ if topic is None else topic.rate_hz or ANY_HZ)


class Ledger:
    """The counts of every recorded key."""

    def __init__(self, robot: str, chosen: KeyFilter) -> None:
        self._robot = robot
        self._chosen = chosen
        self._counts: dict[str, KeyCounts | None] = {}

    def counts(self, key: str) -> KeyCounts | None:
        """None for a key that is not recorded."""
        if key not in self._counts:
            topic = topic_named(key.removeprefix(f"{self._robot}/"))
            recorded = key in self._chosen and (topic is None or topic.recorded)
            self._counts[key] = counts_of(key, self._robot) if recorded else None
        return self._counts[key]

    def missing(self) -> Missing:
        """Keys with dropped or lost messages. Thread-safe; the numbers may lag by a message."""
        counts = [(key, count) for key, count in list(self._counts.items()) if count is not None]
        return Missing(
            dropped={key: count.dropped for key, count in counts if count.dropped},
            lost={key: count.lost for key, count in counts if count.lost},
        )


class Growth:
    """The growth of the captures over the last minute."""

    def __init__(self) -> None:
        self._sizes: deque[tuple[int, int]] = deque()

    def rate(self, size_bytes: int, now_ns: int) -> float:
        """Bytes per second since a minute ago; 0 at first."""
        self._sizes.append((now_ns, size_bytes))
        while now_ns - self._sizes[0][0] > GROWTH_S * NS and len(self._sizes) > 2:
            self._sizes.popleft()
        first_ns, first_bytes = self._sizes[0]
        return max(size_bytes - first_bytes, 0) * NS / (now_ns - first_ns) if now_ns > first_ns else 0.0


class Recorder:
    """Usage: `start`, then `report` until cancelled, `close` to stop receiving, and `end` after the sink has been
    closed."""

    def __init__(
        self, node: Node, ledger: Ledger, sink: RecordingSink, log_clock: LogClock | None, fetch_s: float
    ) -> None:
        """Without `log_clock`, log times are the node's virtual time. `fetch_s` is the period at which received
        messages, each stamped on arrival, are fetched and written: few long turns cost less than many short ones."""
        self._node = node
        self._ledger = ledger
        self._sink = sink
        self._log_clock = log_clock
        self._fetch_s = fetch_s
        self._disturbed: tuple[DisturbedFile, ...] = ()
        self._handles: list[Handle] = []
        self._head = msgspec.msgpack.Decoder(MessageHead)
        self._clock: Clock | None = None
        self._clock_key = CLOCK.key(node.robot_name)
        self._time = msgspec.msgpack.Decoder(ClockTick)
        self._newest_ns = 0
        self._alive: dict[str, bool] = {}
        self._watch = Watch(node.robot_name, self._on_occasion)
        self._growth = Growth()
        self._deleted = 0

    def start(self) -> None:
        robot, bus = self._node.robot_name, self._node.bus
        if self._node.clock.needs_ticks:
            self._clock = self._node.drive_clock()
        if left_out := unrecorded():
            self._node.log.info("not recorded, as declared: %s", ", ".join(left_out))
        self._remember_run()
        # The bus drops nothing before this loop has fetched it; the sink limits what may wait. The expression is not
        # that of a person who hears all keys: a gateway would never forget him (tests/test_zenoh_left.py).
        self._handles.append(bus.listen(f"{robot}/*/**", self._on_batch, self._fetch_s))
        self._handles.append(bus.watch_alive(f"{robot}/**", self._on_alive))
        self._handles.append(bus.declare_alive(recorder_key(robot, self._node.name)))

    def close(self) -> None:
        for handle in self._handles:
            handle.close()
        self._watch.close(self._log_ns(None))

    async def report(self) -> None:
        """Publish progress every REPORT_S, and immediately after a new fault and when an occasion begins or ends."""
        fault, reported_s, occasion = "", -REPORT_S, ""
        loop = asyncio.get_running_loop()
        while True:
            self._watch.look(self._log_ns(None))
            self._report_deleted()
            progress = self._sink.progress()
            if (now := f"{progress.file} {progress.occasion}") != occasion:
                occasion, reported_s = now, -REPORT_S
            if progress.fault != fault or progress.disturbed != self._disturbed:
                fault, reported_s = progress.fault, -REPORT_S
                self._report_faults(progress)
            self._check_wall_clock()
            if loop.time() - reported_s >= REPORT_S:
                reported_s = loop.time()
                self.publish_progress(ended=False)
            await asyncio.sleep(POLL_S)

    def end(self) -> None:
        """Log and publish the result, after the sink has been closed."""
        progress = self._sink.progress()
        if progress.disturbed != self._disturbed:
            self._report_faults(progress)
        self._node.log.info(
            "%d messages are recorded, the last of them in %s", progress.messages, progress.file or "no file"
        )
        self.publish_progress(ended=True)

    def _report_faults(self, progress: RecordingProgress) -> None:
        """Log new faults and put all of them into the node's health."""
        for file in progress.disturbed:
            if file not in self._disturbed:
                self._node.log.error("%s", describe_disturbance(file))
        if progress.fault:
            self._node.log.error("%s", progress.fault)
        self._disturbed = progress.disturbed
        self._node.faults = (*filter(None, (progress.fault,)), *map(describe_disturbance, progress.disturbed))
        if progress.fault:
            self._node.degraded("not recording")
        elif progress.removed:
            self._node.degraded("messages are lost")

    def _check_wall_clock(self) -> None:
        """Write a step of the wall clock into the capture and the log."""
        step = None if self._log_clock is None else self._log_clock.look()
        if step is not None and self._log_clock is not None:
            self._node.log.warning("the wall clock was %s: log times are not affected", describe_step(step))
            self._sink.remember(WALL_CLOCK, self._log_clock.metadata())

    def publish_progress(self, ended: bool) -> None:
        """Publish the progress once."""
        missing, progress = self._ledger.missing(), self._sink.progress()
        self._node.publish(
            RECORDING.of(self._node.name),
            Recording(
                **progress._asdict(),
                dropped=dict(missing.dropped),
                lost=dict(missing.lost),
                rate_bytes_per_s=self._growth.rate(progress.size_bytes, self._log_ns(None)),
                ended=ended,
            ),
        )

    def _on_occasion(self, what: OccasionNews, occasion: Occasion) -> None:
        # A copy, since the writer may be in another thread.
        self._sink.tell(what, msgspec.structs.replace(occasion))
        if what == "begin":
            self._node.log.info("recorded whole from now on: %s", occasion.what)

    def _report_deleted(self) -> None:
        """Log which captures made room, and put it into the node's health."""
        deleted = self._sink.deleted()
        for name in deleted[self._deleted :]:
            self._node.log.info("deleted to make room for new captures: %s", name)
        if len(deleted) > self._deleted and self._node.state == "ready":
            self._node.ready(f"deleted {len(deleted)} captures to make room, the last of them {deleted[-1]}")
        self._deleted = len(deleted)

    # --- messages ----------------------------------------------------------------------------------

    def _on_batch(self, batch: list[Received]) -> None:
        for key, payload, arrival_ns in batch:
            if key == self._clock_key:
                self._advance_clock(payload)
            counts = self._ledger.counts(key)
            if counts is None:
                continue
            try:
                head = self._head.decode(payload)
            except (msgspec.MsgspecError, ValueError, RecursionError):
                head = MessageHead(seq=counts.arrived)
            counts.count(head)
            self._put(counts, key, head.seq, head.stamp_ns, payload, None, arrival_ns)
            self._watch.see(key, payload, self._newest_ns)
        self._sink.write()

    def _advance_clock(self, payload: Payload) -> None:
        """The recorder receives every key, so the clock needs no subscription."""
        if self._clock is None:
            return
        with suppress(msgspec.MsgspecError, ValueError, RecursionError):
            tick = self._time.decode(payload)
            self._clock.tick(tick.stamp_ns, tick.incarnation, tick.rate)

    def _on_alive(self, key: str, alive: bool) -> None:
        counts = self._ledger.counts(key)
        changed, self._alive[key] = self._alive.get(key) != alive, alive
        if counts is not None and changed:
            message = Alive(alive=alive, seq=counts.arrived, stamp_ns=self._node.now_ns())
            counts.arrived += 1
            data = msgspec.msgpack.encode(message)
            self._put(counts, key, message.seq, message.stamp_ns, data, ALIVE_INFO, None)
        _, _, rest = key.partition("/")
        service, _, what = rest.partition("/")
        if changed and what == "alive" and service != self._node.name:
            self._watch.alive(service, alive, self._newest_ns)
        if alive and what == "alive" and service != self._node.name:
            self._node.spawn(self._ask_configuration(service))

    def _put(
        self,
        counts: KeyCounts,
        key: str,
        sequence: int,
        stamp_ns: int,
        payload: Payload,
        info: KeyInfo | None,
        arrival_ns: int | None,
    ) -> None:
        # Log times strictly increase, so that they give the order of arrival. Without `arrival_ns` the time is now.
        log_ns = self._newest_ns = max(self._log_ns(arrival_ns), self._newest_ns + 1)
        data = payload if isinstance(payload, bytes) else bytes(payload)
        if not self._sink.offer(QueuedMessage(key, sequence, log_ns, stamp_ns or log_ns, data, info)):
            counts.dropped += 1

    def _log_ns(self, arrival_ns: int | None) -> int:
        if self._log_clock is None:
            return self._node.now_ns()
        return self._log_clock.now_ns() if arrival_ns is None else self._log_clock.at(arrival_ns)

    # --- metadata ----------------------------------------------------------------------------------

    async def _ask_configuration(self, service: str) -> None:
        """Ask a service that has appeared for its configuration; retry while it is too busy to answer."""
        alive_at = alive_key(self._node.robot_name, service)
        for _ in range(TRIES):
            try:
                reply = await self._node.call(ABOUT.of(service), AboutRequest())
            except RemoteError as error:
                self._node.log.info("%s does not state its configuration: %s", service, error)
                return
            except MeshError:
                await asyncio.sleep(RETRY_S)
                if not self._alive.get(alive_at):
                    return
            else:
                self._sink.remember(f"service/{service}", _entries(reply))
                return
        self._node.log.warning("%s has not stated its configuration", service)

    def _remember_run(self) -> None:
        node, clock = self._node, self._log_clock
        started = {}
        if clock is not None:
            started = {"started": datetime.fromtimestamp(clock.now_ns() / NS, UTC).isoformat(), "host": platform.node()}
        run = {
            "robot": node.robot_name,
            "recorder": node.name,
            "log_clock": "robot" if clock is None else "unix",
            "versions": json.dumps(versions()),
            **started,
        }
        self._sink.remember("run", run)
        self._sink.remember("robot", {"description": json.dumps(node.robot.to_data())})
        self._sink.remember(f"service/{node.name}", _entries(node.about()))
        if node.profile:
            self._sink.remember("profile", {"profile": json.dumps(node.profile)})


def _entries(about: AboutReply) -> dict[str, str]:
    """Encode a service's reply as metadata: text as it is, everything else as JSON."""
    entries: dict[str, Any] = msgspec.to_builtins(about, builtin_types=(bytes,))
    for file in entries["files"]:
        file["content"] = base64.b64encode(file["content"]).decode()
    return {name: value if isinstance(value, str) else json.dumps(value) for name, value in entries.items()}
