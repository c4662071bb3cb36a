"""The switch: a process that carries IP packets between the devices of hosts, and obeys its owner's socket.

`python -m sim.network.switch FD`, where FD is its end of a socket pair with the owner, `sim/network/network.py`.
Requests and replies are JSON, a datagram each. When the owner closes its end, or dies, the switch kills what still runs
on the hosts and ends, and nothing of the network is left.
"""

from __future__ import annotations

import json
import os
import select
import shutil
import signal
import socket
import sys
import tempfile
import time
from collections.abc import Sequence
from contextlib import suppress
from functools import partial
from math import inf
from pathlib import Path
from typing import Any

from sim.network import linux
from sim.network.direction import Counts, Direction, Settings

BATCH = 32
"""Packets that are read from a device before others have their turn."""
REQUEST_BYTES = 65536


class Switch:
    def __init__(
        self, owner: socket.socket, devices: Sequence[int], addresses: Sequence[str], mtu: int, seed: int
    ) -> None:
        """`devices` and `addresses`: of the hosts, in one order, by which requests name them."""
        self._owner = owner
        self._sources = [owner.fileno(), *devices]
        self._mtu = mtu
        self._directions = {
            (a, b): Direction(f"{seed} {addresses[a]} {addresses[b]}")
            for a in range(len(devices))
            for b in range(len(devices))
            if a != b
        }
        self._targets: dict[int, dict[bytes, tuple[Direction, int]]] = {
            device: {
                socket.inet_aton(addresses[b]): (self._directions[a, b], devices[b])
                for b in range(len(devices))
                if a != b
            }
            for a, device in enumerate(devices)
        }  # fmt: skip
        self._busy: dict[Direction, int] = {}
        """The directions in which packets are under way, and the devices where they go."""

    def run(self) -> None:
        """Carry packets until the owner closes its end."""
        control = self._owner.fileno()
        while True:
            wait_s = None
            if self._busy:
                next_ns = min(direction.next_ns for direction in self._busy)
                wait_s = None if next_ns == inf else max(0.0, (next_ns - time.monotonic_ns()) / 1e9)
            ready, _, _ = select.select(self._sources, (), (), wait_s)
            for source in ready:
                if source != control:
                    self._read(source)
                elif not self._obey():
                    return
            if self._busy:
                self._deliver()

    def _read(self, device: int) -> None:
        targets, read, write, clock = self._targets[device], os.read, os.write, time.monotonic_ns
        for _ in range(BATCH):
            try:
                packet = read(device, self._mtu)
            except BlockingIOError:
                return
            except OSError:  # a process on the host has removed the device
                self._sources.remove(device)
                return
            target = targets.get(packet[16:20]) if packet[0] >> 4 == 4 else None
            if target is None:
                continue  # for nobody here
            direction, there = target
            if direction.put(packet, clock()):
                with suppress(OSError):
                    write(there, packet)
            elif direction.next_ns != inf:
                self._busy[direction] = there

    def _deliver(self) -> None:
        now_ns = time.monotonic_ns()
        for direction, there in [*self._busy.items()]:
            for packet in direction.take(now_ns):
                with suppress(OSError):  # a device that is down
                    os.write(there, packet)
            if direction.next_ns == inf:
                del self._busy[direction]

    # --- requests -----------------------------------------------------------------------------------

    def _obey(self) -> bool:
        """Carry out a request; False when the owner has gone."""
        try:
            request = self._owner.recv(REQUEST_BYTES)
        except ConnectionError:
            request = b""
        if not request:
            return False
        asked = json.loads(request)
        reply: Any
        try:
            reply = self._answer(
                asked["do"], [self._directions[a, b] for a, b in asked["directions"]], asked.get("values", {})
            )
        except (ValueError, TypeError) as error:
            reply = {"error": str(error)}
        self._owner.send(json.dumps(reply).encode())
        return True

    def _answer(self, verb: str, directions: list[Direction], values: dict[str, Any]) -> Any:
        now_ns = time.monotonic_ns()
        if verb == "set":
            changed = [Settings(**{**vars(direction.settings), **values}) for direction in directions]
            for direction, settings in zip(directions, changed, strict=True):
                direction.change(settings, now_ns)
        elif verb == "cut":
            for_s = values["for_s"]
            for direction in directions:
                direction.cut(inf if for_s is None else now_ns + for_s * 1e9)
        elif verb == "heal":
            for direction in directions:
                direction.heal()
        elif verb == "counts":
            return [*sum((direction.counts for direction in directions), Counts())]
        else:
            raise ValueError(f"no request {verb!r}")
        return None


def serve(owner: socket.socket) -> None:
    """Make the hosts that the first request describes, answer with their folder and namespaces, and carry packets."""
    request = owner.recv(REQUEST_BYTES)
    if not request:
        return
    plan, made = json.loads(request), list[linux.Made]()
    # Its paths must leave room for those of sockets, which take 107 bytes at most.
    folder = Path(tempfile.mkdtemp(prefix="cocoro-", dir=min(tempfile.gettempdir(), "/tmp", key=len)))
    try:
        names = folder / "hosts"
        lines = [f"{address} {name}\n" for name, address in plan["hosts"].items()]
        names.write_text("127.0.0.1 localhost\n::1 localhost\n" + "".join(lines))
        names.chmod(0o644)
        for name, address in plan["hosts"].items():
            made.append(linux.in_thread(partial(linux.make_host, name, address, plan["mtu"], names)))
        linux.be_punctual()
        switch = Switch(owner, [host.device for host in made], [*plan["hosts"].values()], plan["mtu"], plan["seed"])
        socket.send_fds(
            owner, [json.dumps(str(folder)).encode()], [space for host in made for space in host.namespaces]
        )
        switch.run()
    except ConnectionError:
        pass  # the owner has ended
    except OSError as error:
        owner.send(json.dumps({"error": str(error)}).encode())
    finally:
        linux.kill_all([host.namespaces[0] for host in made], but=(os.getpid(), os.getppid()))
        shutil.rmtree(folder, ignore_errors=True)


if __name__ == "__main__":
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)  # these are for the owner, whose end ends this process
    serve(socket.socket(fileno=int(sys.argv[1])))
