"""Control of the emulated hardware: injects faults and inspects devices, by JSON lines over a socket beside the ports.

Each line is one `ControlRequest`, chosen by its "do"; each answer is {"ok": ...} or {"error": "..."}.
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
from sim.wire.emulator import Emulator, Line
from sim.wire.line import Direction, FaultKind, LineFault
from sim.wire.servo import EmulatedServo, EmulatedServoBus

SOCKET = "control"


class Disturb(msgspec.Struct, tag_field="do", tag="disturb", forbid_unknown_fields=True):
    """Disturb the bytes of a line; see `sim.wire.line.LineFault`."""

    line: str
    kind: FaultKind
    share: Share = 0.1
    for_s: float = 1.0
    way: Direction = "both"
    delay_ms: float = 30.0


class Unplug(msgspec.Struct, tag_field="do", tag="unplug", forbid_unknown_fields=True):
    """Unplug a line's adapter."""

    line: str


class Plug(msgspec.Struct, tag_field="do", tag="plug", forbid_unknown_fields=True):
    """Plug a line's adapter in."""

    line: str


class SetSensor(msgspec.Struct, tag_field="do", tag="feel", forbid_unknown_fields=True):
    """Set a sensor of the Create: a field of `sim.wire.create.CreateSensors`."""

    field: str
    value: bool | int | list[bool]


class PowerCycle(msgspec.Struct, tag_field="do", tag="restart", forbid_unknown_fields=True):
    """Interrupt the power of the Create, or of the servo with this ID."""

    servo: int | None = None


class Demo(msgspec.Struct, tag_field="do", tag="demo", forbid_unknown_fields=True):
    """Start a demo, so that the Create leaves its mode without a cause that its sensors show."""


class Mute(msgspec.Struct, tag_field="do", tag="mute", forbid_unknown_fields=True):
    """Disconnect a servo from the line, or connect it again; it keeps its power."""

    servo: int
    value: bool = True


class Trip(msgspec.Struct, tag_field="do", tag="trip", forbid_unknown_fields=True):
    """Shut a servo down with an error bit, such as 32 for overload."""

    servo: int
    error: int = 32


class SetRegister(msgspec.Struct, tag_field="do", tag="put", forbid_unknown_fields=True):
    """Set any register of a servo."""

    servo: int
    address: int
    value: int


class Inspect(msgspec.Struct, tag_field="do", tag="look", forbid_unknown_fields=True):
    """Return the state of the devices, and the wheel commands since the last inspection with their times."""


ControlRequest = Disturb | Unplug | Plug | SetSensor | PowerCycle | Demo | Mute | Trip | SetRegister | Inspect


class Control:
    """Carries out requests. Serve it by `ControlServer`, or call `do` from any thread."""

    def __init__(self, emulator: Emulator) -> None:
        self._emulator = emulator
        devices = [line.device for line in emulator.lines.values()]
        self._create = next((device for device in devices if isinstance(device, EmulatedCreate)), None)
        buses = [device for device in devices if isinstance(device, EmulatedServoBus)]
        self._servos = [servo for bus in buses for servo in bus.servos]

    def do(self, request: ControlRequest) -> Any:
        """Carry out a request; returns the answer. Raises ValueError that says what is wrong with the request."""
        return self._emulator.call(lambda: self._do(request))

    def _do(self, request: ControlRequest) -> Any:
        now_ns = time.monotonic_ns()
        match request:
            case Disturb():
                until_ns = now_ns + round(request.for_s * NS)
                self._line(request.line).disturb(
                    LineFault(request.kind, request.share, request.way, until_ns, round(request.delay_ms * 1e6))
                )
            case Unplug():
                self._line(request.line).port.unplug()
            case Plug():
                self._line(request.line).port.plug()
            case SetSensor():
                if not hasattr(self._base.sensors, request.field):
                    raise ValueError(f"a Create has no sensor {request.field!r}")
                setattr(self._base.sensors, request.field, request.value)
            case PowerCycle(servo=None):
                self._base.power_cycle()
            case PowerCycle(servo=int(number)):
                self._servo(number).power_up()
            case Demo():
                self._base.receive(bytes([135]), self._base.baud, now_ns)
            case Mute():
                self._servo(request.servo).mute = request.value
            case Trip():
                self._servo(request.servo).trip(request.error)
            case SetRegister():
                self._servo(request.servo).put(request.address, request.value)
            case Inspect():
                return self._inspect(now_ns)
        return True

    def _inspect(self, now_ns: int) -> dict[str, Any]:
        state: dict[str, Any] = {"now_ns": now_ns}
        if self._create is not None:
            create = self._create
            state["create"] = {"mode": create.mode, "wheels": create.wheels_mmps, "acted": list(create.acted)}
            create.acted.clear()
        state["wheels"] = {
            servo.number: servo.motor.endless for servo in self._servos if servo.motor.endless is not None
        }
        state["servos"] = {servo.number: servo.looks for servo in self._servos}
        for servo in self._servos:
            servo.acted.clear()
        return state

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
    """Answers requests on a socket in the folder of the ports. A context manager."""

    def __init__(self, folder: Path, control: Control) -> None:
        self._path = folder / SOCKET
        self._path.unlink(missing_ok=True)
        decoder = msgspec.json.Decoder(ControlRequest)

        class Answer(socketserver.StreamRequestHandler):
            def handle(self) -> None:
                for line in self.rfile:
                    try:
                        answer: dict[str, Any] = {"ok": control.do(decoder.decode(line))}
                    except ValueError as error:  # also msgspec's errors
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
