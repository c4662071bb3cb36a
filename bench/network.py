"""Measures the emulated network of hosts (sim/network): delays, jitter, loss, throughput, and zenoh after a cut.

Delays are compared with those that were asked for, one way, by the steady clock that all hosts share. Shares of a core
are those of the switch, which forwards the packets. Runs as root.
"""

from __future__ import annotations

import argparse
import socket
import statistics
import struct
import threading
import time
from collections.abc import Callable
from typing import NamedTuple

import psutil

from bench.network_speaker import Speaker
from bench.report import Report, Table, number, percentile
from bench.trials import sized
from sim.network.network import Network

PORT = 5000
SO_TIMESTAMPNS = 35
"""Has the system stamp each packet that a socket receives: socket(7)."""
CHUNK = 1 << 16
RATE_HZ = 20_000
SMALL_BYTES = 100
BURST_S = 0.001
CUT_S, LONG_CUT_S = 3.0, 10.0
SETTLE_S = 1.0
"""Between the cuts."""
LIFE_S = 3600
PATIENCE_S = 60.0


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--count", type=int, help="packets for each delay and each jitter (500)")


def measure(chosen: argparse.Namespace, report: Report) -> None:
    count = sized(chosen, chosen.count, 500, 50)
    with Network("base", "brain") as network:
        _delays(network, count, report)
        _loss(network, 1000 if chosen.short else 10_000, report)
        _packets(network, 1.0 if chosen.short else 5.0, report)
    for mtu in (1500, 9000, 65535):
        with Network("base", "brain", mtu=mtu) as network:
            _stream(network, (50 if chosen.short else 300) << 20, f"TCP, MTU {mtu}", report)
            if mtu == 1500:
                network.links().set(rate_bps=20e6)
                _stream(network, (2 if chosen.short else 10) << 20, "TCP at a rate of 2.5 MB/s", report)
    _reconnections(2 if chosen.short else 20, report)


# --- datagrams ----------------------------------------------------------------------------------------


class Pair(NamedTuple):
    """A datagram socket on base, connected to one on brain."""

    sender: socket.socket
    receiver: socket.socket


def _pair(network: Network) -> Pair:
    brain = network.host("brain")
    pair = Pair(network.host("base").socket(socket.SOCK_DGRAM), brain.socket(socket.SOCK_DGRAM))
    pair.receiver.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
    pair.receiver.bind((brain.address, PORT))
    pair.receiver.settimeout(PATIENCE_S)
    pair.sender.connect((brain.address, PORT))
    return pair


def _delays(network: Network, count: int, report: Report) -> None:
    rows = []
    pair = _pair(network)
    asked: list[dict[str, float | str]] = [
        {"delay_ms": 0.0}, {"delay_ms": 1.0}, {"delay_ms": 20.0}, {"delay_ms": 100.0},
        {"delay_ms": 20.0, "jitter_ms": 10.0},
        {"delay_ms": 20.0, "jitter_ms": 5.0, "distribution": "normal"},
    ]  # fmt: skip
    for settings in asked:
        network.links().set(**{"jitter_ms": 0.0, "distribution": "uniform", **settings})
        jitters, wanted_ms = "jitter_ms" in settings, float(settings["delay_ms"])
        spans = [_one_way_ms(pair) for _ in range(count)]
        errors = [span - wanted_ms for span in spans]
        words = ", ".join(f"{key} {value}" for key, value in settings.items())
        if not jitters:
            report.value(f"delay beyond the asked, {words}", errors, "ms")
        shown = [statistics.median(spans), statistics.pstdev(spans), *(percentile(spans, p) for p in (0, 1, 99, 100))]
        rows.append([words, *(number(value) for value in shown)])
    report.tables.append(Table("Delays one way, ms", ["asked", "median", "sd", "least", "1%", "99%", "most"], rows))
    network.links().set(delay_ms=0.0, jitter_ms=0.0)
    for end in pair:
        end.close()


def _one_way_ms(pair: Pair) -> float:
    """From sending a packet until the network of the other host has it, whenever the receiver gets the processor."""
    begun_ns = time.time_ns()
    pair.sender.send(bytes(SMALL_BYTES))
    _, [(_, _, stamp)], _, _ = pair.receiver.recvmsg(SMALL_BYTES, 64)
    seconds, ns = struct.unpack("=qq", stamp)
    came_ns: int = seconds * 10**9 + ns
    return (came_ns - begun_ns) / 1e6


def _loss(network: Network, count: int, report: Report) -> None:
    pair = _pair(network)
    direction = network.direction("base", "brain")
    direction.set(loss=0.01)
    before = direction.counts()
    _send(pair, count, RATE_HZ)
    while (now := direction.counts()).sent - before.sent < count:
        time.sleep(0.01)
    report.value("lost at a probability of 1%", [100 * (now.lost - before.lost) / count], "%")
    direction.set(loss=0.0)
    for end in pair:
        end.close()


def _send(pair: Pair, count: int, rate_hz: float) -> None:
    """Send small packets at a mean rate, in bursts of a millisecond."""
    burst = max(1, round(rate_hz * BURST_S))
    due_s = time.monotonic()
    for number_of_burst in range(-(-count // burst)):
        for _ in range(min(burst, count - number_of_burst * burst)):
            pair.sender.send(bytes(SMALL_BYTES))
        due_s += burst / rate_hz
        time.sleep(max(0.0, due_s - time.monotonic()))


def _packets(network: Network, seconds: float, report: Report) -> None:
    pair = _pair(network)
    direction = network.direction("base", "brain")
    for delay_ms in (0.0, 20.0):
        direction.set(delay_ms=delay_ms)
        before = direction.counts()
        count = round(seconds * RATE_HZ)
        share, lasted_s = _share(network, lambda: _send(pair, count, RATE_HZ))  # noqa: B023  called at once
        name = f"{SMALL_BYTES} bytes, delay {delay_ms:g} ms"
        report.value(f"{name}: packets/s forwarded", [(direction.counts().sent - before.sent) / lasted_s], "Hz")
        report.value(f"{name}: share of a core", [100 * share], "%")
    direction.set(delay_ms=0.0)
    for end in pair:
        end.close()


def _share(network: Network, work: Callable[[], object]) -> tuple[float, float]:
    """The switch's share of a core during work, and how long that took, s."""
    process = psutil.Process(network.switch_pid)
    before, begun_s = process.cpu_times(), time.monotonic()
    work()
    lasted_s, after = time.monotonic() - begun_s, process.cpu_times()
    return (after.user + after.system - before.user - before.system) / lasted_s, lasted_s


# --- streams ------------------------------------------------------------------------------------------


def _stream(network: Network, size: int, name: str, report: Report) -> None:
    brain, counts = network.host("brain"), network.direction("base", "brain").counts
    with brain.socket() as listener:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind((brain.address, PORT))
        listener.listen()
        sender = network.host("base").socket()
        sender.connect((brain.address, PORT))
        receiver, _ = listener.accept()
    before = counts().delivered
    with sender, receiver:
        share, lasted_s = _share(network, lambda: _transfer(sender, receiver, size))
    report.value(f"{name}: bytes/s", [size / lasted_s / 1e6], "MB/s")
    report.value(f"{name}: packets/s forwarded", [(counts().delivered - before) / lasted_s], "Hz")
    report.value(f"{name}: share of a core", [100 * share], "%")


def _transfer(sender: socket.socket, receiver: socket.socket, size: int) -> None:
    thread = threading.Thread(target=lambda: sender.sendall(bytes(size)))
    thread.start()
    room = bytearray(CHUNK)
    while size > 0:
        size -= receiver.recv_into(room)
    thread.join()


# --- zenoh --------------------------------------------------------------------------------------------


def _reconnections(count: int, report: Report) -> None:
    """Time from the end of a cut until the client's subscription has a message again."""
    for lease_s, cut_s, times_cut in ((4.0, CUT_S, count), (1.0, CUT_S, count), (4.0, LONG_CUT_S, count // 2)):
        with Network("base", "brain") as network:
            network.links().set(delay_ms=20)
            base, brain = network.host("base"), network.host("brain")
            endpoint = f"tcp/{base.address}:7447"
            Speaker(base, "router", endpoint, lease_s, LIFE_S)
            client = Speaker(brain, "client", endpoint, lease_s, LIFE_S)
            times = []
            for _ in range(times_cut):
                client.heard_after(time.monotonic() + SETTLE_S)
                network.cut("base")
                time.sleep(cut_s)
                network.heal()
                healed_s = time.monotonic()
                times.append(client.heard_after(healed_s) - healed_s)
        report.value(f"zenoh, lease {lease_s:g} s, hears again after a cut of {cut_s:g} s", times, "s")
