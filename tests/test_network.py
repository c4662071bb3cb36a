"""Hosts with a network between them: what is a host's own, what a link does to packets, and what is left at the end."""

from __future__ import annotations

import json
import os
import select
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path

import pytest
from network_rig import network_of

from cocoro.errors import CocoroError
from sim.network.direction import Direction
from sim.network.network import Host, Network, obstacle

pytestmark = pytest.mark.process

PORT = 5000
PATIENCE_S = 30.0


def ends(sender: Host, receiver: Host) -> tuple[socket.socket, socket.socket]:
    """A datagram socket on each; the first is connected to the second."""
    here, there = (host.socket(socket.SOCK_DGRAM) for host in (sender, receiver))
    there.bind((receiver.address, PORT))
    there.settimeout(PATIENCE_S)
    here.connect((receiver.address, PORT))
    return here, there


def wait_for(content: Callable[[], bool]) -> None:
    """Ask the switch until a condition holds."""
    end_s = time.monotonic() + PATIENCE_S
    while not content():
        assert time.monotonic() < end_s


def arrived(receiver: socket.socket) -> list[bytes]:
    """What has been delivered."""
    receiver.setblocking(False)
    found = []
    try:
        while True:
            found.append(receiver.recv(100))
    except BlockingIOError:
        return found
    finally:
        receiver.settimeout(PATIENCE_S)


def test_a_process_runs_on_its_host() -> None:
    program = """
import json, os, socket
names = [name for _, name in socket.if_nameindex()]
shared = os.listdir("/dev/shm")
open("/dev/shm/mine", "w").close()
places = {name: os.environ[f"COCORO_{name}_DIR"] for name in ("RUN", "STATE", "CAPTURE")}
print(json.dumps([socket.gethostname(), socket.gethostbyname("brain"), names, shared, os.environ["OWN"], places]))
"""
    with network_of("base", "brain") as network:
        told = []
        for name in ("base", "brain"):
            process = network.host(name).run([sys.executable, "-c", program], {"OWN": name}, stdout=subprocess.PIPE)
            assert process.stdout is not None
            told.append(json.loads(process.stdout.read()))
            assert process.wait() == 0
            process.stdout.close()
        places = [Path(place) for host in told for place in host[-1].values()]
        for name, host in zip(("base", "brain"), told, strict=True):
            assert host[0] == host[-2] == name
            assert host[1] == "10.77.0.2"
            assert sorted(host[2]) == ["lo", "net0"]
            assert host[3] == [], "memory is not shared between hosts"
        assert len({*places}) == 6
        assert all(place.stat().st_mode & 0o777 == 0o700 for place in places)
        prefixed = subprocess.run([*network.host("brain").prefix, "hostname"], capture_output=True, check=False)
        assert prefixed.stdout == b"brain\n"
    assert not any(place.exists() for place in places)


def test_packets_come_after_the_delay_of_their_direction() -> None:
    with network_of("base", "brain", "desk") as network:
        network.direction("base", "brain").set(delay_ms=30)
        here, there = ends(network.host("base"), network.host("brain"))
        with here, there:
            sent_s = time.monotonic()
            here.send(b"question")
            question, asker = there.recvfrom(100)
            assert question == b"question"
            assert asker[0] == "10.77.0.1"
            assert time.monotonic() - sent_s >= 0.03
            there.sendto(b"answer", asker)
            here.settimeout(PATIENCE_S)
            assert here.recv(100) == b"answer"
        assert network.direction("base", "brain").counts().delivered == 1
        assert network.link("base", "brain").counts().delivered == 2
        assert network.links("base").counts().delivered == 2
        assert network.links("desk").counts().sent == 0


def test_the_seed_says_which_packets_are_lost() -> None:
    count = 1000
    with network_of("base", "brain", seed=7) as network:
        direction = network.direction("base", "brain")
        direction.set(loss=0.1)
        here, there = ends(network.host("base"), network.host("brain"))
        came = []

        def is_sent(wanted: int) -> bool:
            return direction.counts().sent == wanted

        with here, there:
            for number in range(count):
                here.send(number.to_bytes(4, "big"))
                if number % 100 == 99:
                    wait_for(partial(is_sent, number + 1))
                    came += [int.from_bytes(packet, "big") for packet in arrived(there)]
        assert direction.counts() == (len(came), count - len(came), 0, 0, 0)
    model = Direction("7 10.77.0.1 10.77.0.2")
    model.change(model.settings.__class__(loss=0.1), 0)
    assert came == [number for number in range(count) if model.put(b"", 0)]


def test_nothing_arrives_during_a_cut() -> None:
    with network_of("base", "brain") as network:
        here, there = ends(network.host("base"), network.host("brain"))
        direction = network.direction("base", "brain")
        with here, there:
            direction.set(delay_ms=60_000)
            here.send(b"under direction")
            wait_for(lambda: direction.counts().underway == 1)
            network.cut("brain")
            direction.set(delay_ms=0)
            here.send(b"sent")
            wait_for(lambda: direction.counts().cut == 2)
            assert arrived(there) == []
            network.heal("brain")
            here.send(b"after")
            assert there.recv(100) == b"after"
            network.cut(for_s=0.05)
            while not select.select([there], [], [], 0.01)[0]:  # ends by itself
                here.send(b"again")
            assert there.recv(100) == b"again"


def test_a_rate_drops_what_its_queue_has_no_room_for() -> None:
    with network_of("base", "brain") as network:
        direction = network.direction("base", "brain")
        direction.set(rate_bps=1, queue_bytes=10 * 1028)  # none is sent within the test; IP and UDP take 28 bytes
        here, there = ends(network.host("base"), network.host("brain"))
        with here, there:
            for _ in range(50):
                here.send(bytes(1000))
            wait_for(lambda: direction.counts().sent == 50)
            assert direction.counts() == (0, 0, 40, 0, 10)
            direction.set(rate_bps=None)
            wait_for(lambda: direction.counts().delivered == 10)


def test_a_large_packet_crosses_whole() -> None:
    with network_of("base", "brain", mtu=65535) as network:
        here, there = ends(network.host("base"), network.host("brain"))
        with here, there:
            here.send(bytes(60_000))
            assert there.recv(1 << 16) == bytes(60_000)
        assert network.links().counts().delivered == 1


def test_links_change_from_several_threads_while_packets_flow() -> None:
    with network_of("base", "brain", "desk") as network, ThreadPoolExecutor(4) as pool:
        here, there = ends(network.host("base"), network.host("brain"))
        with here, there:

            def change(number: int) -> int:
                network.links().set(delay_ms=number % 3, jitter_ms=number % 2)
                here.send(b"x")
                return network.link("base", "desk").counts().sent

            assert not any(pool.map(change, range(400)))
            wait_for(lambda: network.direction("base", "brain").counts().delivered == 400)


def test_names_and_settings_that_cannot_be_are_refused() -> None:
    with network_of("base", "brain") as network:
        with pytest.raises(KeyError, match="no host moon; there are base, brain"):
            network.cut("moon")
        with pytest.raises(ValueError, match="base and base"):
            network.link("base", "base")
        link = network.link("base", "brain")
        with pytest.raises(ValueError, match="loss"):
            link.set(loss=2, delay_ms=50)
        with pytest.raises(ValueError, match="speed"):
            link.set(speed=1)
    for wrong in [("a", "a"), (), ("../a", "b"), ("localhost",)]:
        with pytest.raises(ValueError, match="name"):
            Network(*wrong)


def test_the_reason_is_told_where_there_is_no_network_to_be_had(monkeypatch: pytest.MonkeyPatch) -> None:
    obstacle.cache_clear()
    try:
        monkeypatch.setattr(os, "geteuid", lambda: 1000)
        assert "root" in obstacle()
    finally:
        obstacle.cache_clear()


def test_a_network_made_by_hand_obeys_lines_and_runs_commands_on_its_hosts() -> None:
    if why := obstacle():
        pytest.skip(why)
    command = [sys.executable, "-m", "sim.network", "base", "brain"]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, bufsize=1) as process:
        assert process.stdin is not None
        assert process.stdout is not None
        first, second, _ = (process.stdout.readline().split() for _ in range(3))
        assert [first[:2], second[:2]] == [["base", "10.77.0.1"], ["brain", "10.77.0.2"]]
        told = subprocess.run([second[2], "sh", "-c", "hostname; pwd"], capture_output=True, text=True, check=True)
        assert told.stdout.split() == ["brain", str(Path.cwd())]

        def said(*lines: str) -> str:
            assert process.stdin is not None
            assert process.stdout is not None
            process.stdin.write("\n".join([*lines, ""]))
            return process.stdout.readline()

        send = "import socket; socket.socket(socket.AF_INET, socket.SOCK_DGRAM).sendto(b'', ('brain', 5000))"
        assert said("set base brain delay_ms=60e3", "counts").startswith("0 delivered")
        subprocess.run([first[2], sys.executable, "-c", send], check=True)
        wait_for(lambda: "1 underway" in said("counts base brain"))
        assert "1 cut" in said("cut base", "heal", "counts")
        assert "moon" in said("cut moon")
        assert "loss" in said("set loss=7")
        assert "'stop'" in said("stop")
        process.stdin.close()
        assert process.wait() == 0


FAMILY = ["sh", "-c", "setsid sleep 1000 & echo $!; exec sleep 1000"]


def test_a_failure_leaves_no_process_and_no_folder() -> None:
    made: list[Path | int] = []

    def fail() -> None:
        with network_of("base") as network:
            host = network.host("base")
            family = host.run(FAMILY, stdout=subprocess.PIPE, text=True)
            assert family.stdout is not None
            made.extend([Path(host.env["COCORO_RUN_DIR"]), os.pidfd_open(family.pid)])
            made.append(os.pidfd_open(int(family.stdout.readline())))
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fail()
    run_dir, *handles = made
    assert isinstance(run_dir, Path)
    assert not run_dir.parent.parent.exists()
    for handle in handles:
        assert isinstance(handle, int)
        assert select.select([handle], [], [], 0)[0], "the process that left its session has ended, too"
        os.close(handle)


OWNER = f"""
import subprocess, sys
from cocoro.errors import CocoroError
from sim.network.network import Network
with Network("base") as network:
    process = network.host("base").run({FAMILY!r}, stdout=subprocess.PIPE, text=True)
    print(process.pid, process.stdout.readline().strip(), network.switch_pid, flush=True)
    print(network.host("base").env["COCORO_RUN_DIR"], flush=True)
    sys.stdin.read()
"""


def test_a_killed_owner_leaves_no_process_and_no_folder() -> None:
    if why := obstacle():
        pytest.skip(why)
    owner = subprocess.Popen([sys.executable, "-c", OWNER], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    assert owner.stdout is not None
    pids = owner.stdout.readline().split()
    folder = Path(owner.stdout.readline().strip()).parent.parent
    assert folder.is_dir()
    handles = [os.pidfd_open(int(pid)) for pid in pids]
    owner.kill()
    owner.communicate()
    for handle in handles:
        assert select.select([handle], [], [], PATIENCE_S)[0]
        os.close(handle)
    assert not folder.exists()


def test_a_network_whose_switch_was_killed_says_so_and_ends() -> None:
    with network_of("base", "brain") as network:
        process = network.host("base").run(["setsid", "sleep", "1000"])
        os.kill(network.switch_pid, 9)
        with pytest.raises(CocoroError, match="switch"):
            network.cut()
    assert process.returncode is not None
