"""Ask emulated hardware for faults and for what it does: JSON lines over a socket beside its ports.

Each line is one `ControlRequest` by its "do"; each answer is {"ok": ...} or {"error": "..."}.
"""

from __future__ import annotations

import socketserver
import threading
import time
from pathlib import Path
from types import TracebackType
from typing import Any

import msgspec

from cocoro.clock import NS
from cocoro.units import Share
from sim.wire.create import EmulatedCreate
from sim.wire.dynamixel import EmulatedServo, EmulatedServoBus
from sim.wire.emulator import Emulator, Line
from sim.wire.line import Direction, FaultKind, LineFault

SOCKET = "control"


class Disturb(msgspec.Struct, tag_field="do", tag="disturb", forbid_unknown_fields=True):
    """Let something happen to the bytes of a line."""

    line: str
    kind: FaultKind
    share: Share = 0.1
    for_s: float = 1.0
    way: Direction = "both"
    delay_ms: float = 30.0


class Unplug(msgspec.Struct, tag_field="do", tag="unplug", forbid_unknown_fields=True):
    """Pull a line's adapter out."""

    line: str


class Plug(msgspec.Struct, tag_field="do", tag="plug", forbid_unknown_fields=True):
    line: str


class SetSensor(msgspec.Struct, tag_field="do", tag="feel", forbid_unknown_fields=True):
    """Have the Create's sensors feel something: a field of `sim.wire.create.Surroundings`."""

    field: str
    value: bool | int | list[bool]


class PowerCycle(msgspec.Struct, tag_field="do", tag="restart", forbid_unknown_fields=True):
    """A brown-out: the Create's, or that of the servo with this ID."""

    servo: int | None = None


class Demo(msgspec.Struct, tag_field="do", tag="demo", forbid_unknown_fields=True):
    """The Create leaves its mode for none of the reasons that it has."""


class Mute(msgspec.Struct, tag_field="do", tag="mute", forbid_unknown_fields=True):
    """A servo's plug is out; it keeps its power."""

    servo: int
    value: bool = True


class Trip(msgspec.Struct, tag_field="do", tag="trip", forbid_unknown_fields=True):
    """A servo shuts down for an error bit, 32 for overload."""

    servo: int
    error: int = 32


class SetRegister(msgspec.Struct, tag_field="do", tag="put", forbid_unknown_fields=True):
    """Set a servo's register, whatever it is."""

    servo: int
    address: int
    value: int


class Inspect(msgspec.Struct, tag_field="do", tag="look", forbid_unknown_fields=True):
    """What the devices do, and when the wheels were asked for what since the last look."""


ControlRequest = Disturb | Unplug | Plug | SetSensor | PowerCycle | Demo | Mute | Trip | SetRegister | Inspect


class Control:
    """Carries out what is asked. `serve` it, or call `do` from any thread."""

    def __init__(self, emulator: Emulator) -> None:
        self._emulator = emulator
        devices = [line.device for line in emulator.lines.values()]
        self._create = next((device for device in devices if isinstance(device, EmulatedCreate)), None)
        buses = [device for device in devices if isinstance(device, EmulatedServoBus)]
        self._servos = [servo for bus in buses for servo in bus.servos]

    def do(self, ask: ControlRequest) -> Any:
        """The answer. Raises ValueError with what is wrong with the question."""
        return self._emulator.call(lambda: self._do(ask))

    def _do(self, ask: ControlRequest) -> Any:
        now_ns = time.monotonic_ns()
        match ask:
            case Disturb():
                until_ns = now_ns + round(ask.for_s * NS)
                self._line(ask.line).disturb(
                    LineFault(ask.kind, ask.share, ask.way, until_ns, round(ask.delay_ms * 1e6))
                )
            case Unplug():
                self._line(ask.line).port.unplug()
            case Plug():
                self._line(ask.line).port.plug()
            case SetSensor():
                if not hasattr(self._base.around, ask.field):
                    raise ValueError(f"a Create feels no {ask.field}")
                setattr(self._base.around, ask.field, ask.value)
            case PowerCycle(servo=None):
                self._base.power_cycle()
            case PowerCycle(servo=int(number)):
                self._servo(number).power_up()
            case Demo():
                self._base.receive(bytes([135]), self._base.baud, now_ns)
            case Mute():
                self._servo(ask.servo).mute = ask.value
            case Trip():
                self._servo(ask.servo).trip(ask.error)
            case SetRegister():
                self._servo(ask.servo).put(ask.address, ask.value)
            case Inspect():
                return self._look(now_ns)
        return True

    def _look(self, now_ns: int) -> dict[str, Any]:
        told: dict[str, Any] = {"now_ns": now_ns}
        if self._create is not None:
            create = self._create
            told["create"] = {"mode": create.mode, "wheels": create.wheels_mmps, "acted": list(create.acted)}
            create.acted.clear()
        told["servos"] = {
            servo.number: {
                "position": servo.get(36),
                "goal": servo.get(30),
                "torque": servo.get(24),
                "torque_limit": servo.get(34),
                "error": servo.error,
            }
            for servo in self._servos
        }
        for servo in self._servos:
            servo.acted.clear()
        return told

    @property
    def _base(self) -> EmulatedCreate:
        if self._create is None:
            raise ValueError("there is no Create here")
        return self._create

    def _line(self, name: str) -> Line:
        if name not in self._emulator.lines:
            raise ValueError(f"there is no line {name!r}; known are {', '.join(self._emulator.lines)}")
        return self._emulator.lines[name]

    def _servo(self, number: int) -> EmulatedServo:
        for servo in self._servos:
            if servo.number == number:
                return servo
        raise ValueError(f"there is no servo {number}")


class ControlServer:
    """Answers on a socket in the folder of the ports. Use it as a context manager."""

    def __init__(self, folder: Path, control: Control) -> None:
        self._path = folder / SOCKET
        self._path.unlink(missing_ok=True)
        decoder = msgspec.json.Decoder(ControlRequest)

        class Answer(socketserver.StreamRequestHandler):
            def handle(self) -> None:
                for line in self.rfile:
                    try:
                        answer: dict[str, Any] = {"ok": control.do(decoder.decode(line))}
                    except ValueError as error:  # msgspec's are such
                        answer = {"error": str(error)}
                    self.wfile.write(msgspec.json.encode(answer) + b"\n")

        class Server(socketserver.ThreadingMixIn, socketserver.UnixStreamServer):
            daemon_threads = True
            block_on_close = False

        self._server = Server(str(self._path), Answer)
        self._thread = threading.Thread(target=self._server.serve_forever, name="control", daemon=True)

    def __enter__(self) -> ControlServer:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._server.shutdown()
        self._server.server_close()
        self._path.unlink(missing_ok=True)
        self._thread.join()
