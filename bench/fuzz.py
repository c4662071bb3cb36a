"""Feeds mutated bytes to both hardware parsers: `python -m bench fuzz --seconds 300 --seed 0`.

Valid frames are flipped, cut, spliced, doubled and mixed with noise, and fed in random pieces. Every parsed frame must
be valid by an independent check; an exception ends the run.
"""

from __future__ import annotations

import argparse
import random
import time
from collections.abc import Callable

from bench.report import Report
from bench.trials import sized
from services.base import oi
from services.base.guard_logic import LONG, MS, SHORT, GuardLogic
from services.servos.bus import find_status
from services.servos.families import FAMILIES

NOISE = (0x13, 0xFF, 0x00, 0x23, 0x29)
"""Bytes that occur as headers and lengths of frames."""


class Fuzzer:
    def __init__(self, seed: int) -> None:
        self._draws = random.Random(seed)
        self.runs = self.found = 0

    def mutated(self, good: Callable[[], bytes]) -> bytes:
        draws = self._draws
        data = bytearray(b"".join(good() for _ in range(draws.randrange(1, 5))))
        for _ in range(draws.randrange(0, 6)):
            at = draws.randrange(len(data) + 1)
            end = min(at + draws.randrange(1, 12), len(data))
            match draws.randrange(6):
                case 0 if at < len(data):
                    data[at] ^= draws.randrange(1, 256)
                case 1:
                    del data[at:end]
                case 2:
                    data[at:at] = bytes(draws.choice(NOISE) for _ in range(draws.randrange(1, 6)))
                case 3:
                    data[at:at] = data[at:end]
                case 4:
                    data[at:at] = draws.randbytes(draws.randrange(1, 20))
                case _:
                    data[at:end] = draws.randbytes(end - at)
        return bytes(data)

    def create(self) -> None:
        """The stream parser alone, and the guard's state machine behind it."""
        draws = self._draws

        def good() -> bytes:
            packets = draws.choice((SHORT, LONG))
            payload = b""
            for packet in packets:
                about = oi.PACKETS[packet]
                value = draws.choice((about.low, about.high, draws.randint(about.low, about.high)))
                payload += bytes([packet]) + value.to_bytes(about.size, "big", signed=about.signed)
            body = bytes([19, len(payload)]) + payload
            return body + bytes([-sum(body) & 0xFF])

        data = self.mutated(good)
        logic, now_ns = GuardLogic("safe", 200 * MS), 10**12
        logic.opened(now_ns)
        parser = oi.StreamParser((SHORT, LONG))
        frames, at = [], 0
        while at < len(data):
            piece = data[at : at + draws.randrange(1, 40)]
            at += len(piece)
            now_ns += draws.randrange(1, 60) * MS
            frames += parser.feed(piece)
            logic.receive(piece, now_ns)
            logic.ask(draws.randint(-900, 900), draws.randint(-900, 900), now_ns + draws.randint(-50, 400) * MS, now_ns)
            written = logic.poll(now_ns)
            assert logic.wheels[:2] == (0, 0) or logic.link == "up"
            assert len(written) < 2 * 5 * oi.OVERRUN + 100
        for readings in frames:
            assert tuple(readings) in (SHORT, LONG)
            size = oi.length(LONG if len(readings) == len(LONG) else SHORT)
            whole = [data[i : i + size + 3] for i in range(len(data)) if data[i] == 19]
            assert any(sum(frame) % 256 == 0 and frame[1] == len(frame) - 3 for frame in whole if len(frame) > 3)
        self.found += len(frames)

    def servo(self) -> None:
        draws = self._draws
        number, length = draws.randrange(254), draws.choice((0, 1, 2, 8))
        family = draws.choice(tuple(FAMILIES.values()))

        def good() -> bytes:
            data = draws.randbytes(draws.choice((length, length, draws.randrange(20))))
            who = draws.choice((number, number, draws.randrange(254)))
            body = bytes([who, len(data) + 2, draws.choice((0, 0, 0x20, draws.randrange(128)))]) + data
            return b"\xff\xff" + body + bytes([~sum(body) & 0xFF])

        data = self.mutated(good)
        found = find_status(data, number, length, family.refusals)
        if found is not None:
            assert found.packet in data
            assert found.packet[:3] == bytes([0xFF, 0xFF, number])
            assert sum(found.packet[2:]) & 0xFF == 0xFF
            assert len(found.data) == length or (not found.data and found.error & family.refusals)
            self.found += 1
            if length == 8 and len(found.data) == 8:
                reading = family.reading(found.data, found.error, 0)
                assert reading is None or abs(reading.load) <= 1023

    def run(self, seconds: float) -> None:
        end_s = time.monotonic() + seconds
        while time.monotonic() < end_s:
            for _ in range(100):
                self.create()
                self.servo()
                self.runs += 2


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--seconds", type=float, help="how long (300)")
    parser.add_argument("--seed", type=int, default=0)


def measure(chosen: argparse.Namespace, report: Report) -> None:
    fuzzer = Fuzzer(chosen.seed)
    seconds = sized(chosen, chosen.seconds, 300.0, 3.0)
    fuzzer.run(seconds)
    report.value("fed", [fuzzer.runs], "inputs", at_least=1)
    report.value("whole among them", [fuzzer.found], "frames and packets", at_least=1)
    report.value("speed", [fuzzer.runs / seconds], "inputs/s")
    report.notes.append("nothing but clean rejections")
