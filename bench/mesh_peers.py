"""Other ways to send between processes, for `bench.mesh`, each with what its documentation recommends for speed.

All hand the receiver the bytes of a message; those that can, without copying them. What a program would do with them
(decode, check, count) they leave to the program, as raw zenoh does.
"""

from __future__ import annotations

import ctypes
import os
import sys
import threading
from pathlib import Path
from typing import Any, ClassVar

from bench.mesh_pixels import colour, depth
from bench.mesh_process import FRAME_BYTES, SMALL_BYTES, STAMP_BYTES, Role, Way, stamp, stamped
from cocoro.clock import steady_ns

LARGEST_BYTES = FRAME_BYTES + STAMP_BYTES
REST = bytes(SMALL_BYTES - STAMP_BYTES)


def frame() -> bytes:
    """A frame with the present time in front, as one piece of memory."""
    now = steady_ns().to_bytes(STAMP_BYTES, "little")
    return b"".join((now, colour.data, depth.data))


class Waits(Way):
    """A way whose program waits for the next message in a loop of its own."""

    def receive(self) -> None:
        """Wait for one message and hand it to the tally."""
        raise NotImplementedError

    def receive_forever(self) -> None:
        while True:
            self.receive()

    def bounce(self, count: int) -> list[int]:
        self.tally.begin(count, echo=False)
        for _ in range(count):
            self.send_small()
            self.receive()
        return self.tally.took_ns

    def took(self, data: bytes | memoryview) -> None:
        self.tally.arrived(steady_ns() - stamp(data))


class ZmqWay(Waits):
    """PUB and SUB over Unix sockets; frames are sent and received without ZeroMQ's own copies."""

    def open(self) -> None:
        import zmq

        self._context = zmq.Context()
        self._out, self._in = self._context.socket(zmq.PUB), self._context.socket(zmq.SUB)
        self._out.bind(f"ipc://{self.folder}/{self.role}")
        self._in.setsockopt(zmq.SUBSCRIBE, b"")
        self._in.connect(f"ipc://{self.folder}/{self.other}")

    def send_small(self) -> None:
        self._out.send(stamped(REST))

    def send_frame(self) -> None:
        self._out.send(frame(), copy=False)

    def receive(self) -> None:
        self.took(self._in.recv(copy=False).buffer)

    def close(self) -> None:
        """The context ends with the process."""


class IceoryxWay(Waits):
    """Loaned memory that the receiver reads in place, and a notification for each message, for which it sleeps."""

    def open(self) -> None:
        import iceoryx2 as iox2

        iox2.set_log_level(iox2.LogLevel.Error)
        self._node = iox2.NodeBuilder.new().create(iox2.ServiceType.Ipc)
        self._out, self._notifier = self._ports(iox2, self.role)[:2]
        self._subscriber, self._listener = self._ports(iox2, self.other)[2:]

    def _ports(self, iox2: Any, role: Role) -> tuple[Any, Any, Any, Any]:
        name = iox2.ServiceName.new(f"{self.folder.name}/{role}")
        event = self._node.service_builder(name).event().open_or_create()
        data = (
            self._node.service_builder(name)
            .publish_subscribe(iox2.Slice[ctypes.c_uint8])
            .subscriber_max_buffer_size(256)
            .open_or_create()
        )
        if role == self.role:
            publisher = data.publisher_builder().initial_max_slice_len(LARGEST_BYTES).create()
            return publisher, event.notifier_builder().create(), None, None
        return None, None, data.subscriber_builder().create(), event.listener_builder().create()

    def _send(self, *parts: Any) -> None:
        sample = self._out.loan_slice_uninit(sum(map(len, parts)))
        at = sample.payload_ptr
        for part in parts:
            ctypes.memmove(at, part if isinstance(part, bytes) else part.ctypes.data, len(part))
            at += len(part)
        sample.assume_init().send()
        self._notifier.notify()

    def send_small(self) -> None:
        self._send(stamped(REST))

    def send_frame(self) -> None:
        self._send(steady_ns().to_bytes(STAMP_BYTES, "little"), colour, depth)

    def receive(self) -> None:
        while (sample := self._subscriber.receive()) is None:
            self._listener.blocking_wait()
        self.took(sample.payload().as_memory_view())
        sample.delete()

    def close(self) -> None:
        """The ports end with the process."""


class EcalWay(Way):
    """Shared memory, on this machine alone; calls back in a thread of its own."""

    def open(self) -> None:
        import ecal.nanobind_core as ecal

        ecal.initialize(f"mesh-{self.role}")
        name = self.folder.name
        self._out = ecal.Publisher(f"{name}-{self.role}")
        self._in = ecal.Subscriber(f"{name}-{self.other}")
        self._in.set_receive_callback(self._arrive)

    def _arrive(self, _publisher: Any, _type: Any, data: Any) -> None:
        self.tally.arrived(steady_ns() - stamp(data.buffer))

    def send_small(self) -> None:
        self._out.send(stamped(REST))

    def send_frame(self) -> None:
        self._out.send(frame())

    def close(self) -> None:
        """The publisher ends with the process."""


DATAFLOW = """
nodes:
  - id: a
    path: {python}
    args: -m bench.mesh_process dora a {folder}
    inputs:
      back: b/out
    outputs:
      - out
  - id: b
    path: {python}
    args: -m bench.mesh_process dora b {folder}
    inputs:
      there:
        source: a/out
        queue_size: 256
    outputs:
      - out
"""


class DoraWay(Waits):
    """Two nodes of a dataflow, which dora's own daemon starts; Arrow arrays, in shared memory from 4 KiB on."""

    receives_in_main: ClassVar[bool] = True

    def open(self) -> None:
        import dora
        import pyarrow

        self._array = pyarrow.array
        self._buffer = pyarrow.py_buffer
        self._types = pyarrow.uint8()
        self._from = pyarrow.Array.from_buffers
        self._node = dora.Node()

    def _send(self, data: bytes) -> None:
        self._node.send_output("out", self._from(self._types, len(data), [None, self._buffer(data)]))

    def send_small(self) -> None:
        self._send(stamped(REST))

    def send_frame(self) -> None:
        self._send(frame())

    def receive(self) -> None:
        event = self._node.next()
        if event is None:
            os._exit(0)
        if event["type"] == "INPUT":
            self.took(event["value"].buffers()[1])
        elif event["type"] == "STOP":
            os._exit(0)
        else:
            self.receive()

    def close(self) -> None:
        """The dataflow ends with the process."""


def start_dora(folder: Path) -> None:
    """Runs the dataflow until its nodes have ended; for a process of its own."""
    import dora

    path = folder / "dataflow.yml"
    path.write_text(DATAFLOW.format(python=sys.executable, folder=folder))
    dora.run(str(path))


def say_why(error: BaseException) -> None:
    """Nothing that a thread of a library raises may go unseen."""
    print(f"bench.mesh_peers: {type(error).__name__}: {error}", file=sys.stderr)
    os._exit(1)


threading.excepthook = lambda told: say_why(told.exc_value or RuntimeError("a thread failed"))
