"""Hosts with a network between them, as tests, benches and first steps use it.

with Network("base", "brain") as network:
    network.link("base", "brain").set(delay_ms=20, jitter_ms=10, loss=0.005)
    robot = network.host("base").run(["cocoro", "up", "sim"])
    network.cut("base")
    network.heal()
"""

from __future__ import annotations

import json
import os
import re
import shutil
import socket
import subprocess
import threading
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

from cocoro import child
from cocoro.errors import CocoroError
from sim.network import linux
from sim.network.direction import Counts

P = ParamSpec("P")
T = TypeVar("T")

NETWORK = "10.77.0"
MOST_HOSTS = 32
END_S = 5.0
"""Longest wait for a process that was asked to end; after it, it is killed."""
_NAME = re.compile(r"[a-z0-9]([a-z0-9-]{0,61}[a-z0-9])?")


@cache
def obstacle() -> str:
    """The reason for which no network of hosts is to be had here, or ''. Tries it."""
    if os.geteuid() != 0:
        return "only root can make a network of hosts"
    try:
        made = linux.in_thread(lambda: linux.make_host("probe", f"{NETWORK}.1", 1500))
    except OSError as error:
        return f"no network of hosts here: {error}"
    for descriptor in (made.device, *made.namespaces):
        os.close(descriptor)
    return ""


class Link:
    """Directions between hosts, which are set, cut and counted together. May be used from any thread. A change holds as
    soon as its call has returned."""

    def __init__(self, ask: Callable[..., Any], directions: Sequence[tuple[int, int]]) -> None:
        self._ask = ask
        self._directions = directions

    def set(self, **settings: Any) -> None:
        """Change settings of each direction; the others stay. They are the fields of `Settings` in
        `sim/network/direction.py`: delay_ms, jitter_ms, distribution, reorder, loss, rate_bps, queue_bytes. Raises
        ValueError for what no direction can do."""
        self._ask("set", self._directions, settings)

    def cut(self, for_s: float | None = None) -> None:
        """Lose every packet, also those under way, until `heal` or for a time."""
        self._ask("cut", self._directions, {"for_s": for_s})

    def heal(self) -> None:
        """End a cut. The settings are as before."""
        self._ask("heal", self._directions)

    def counts(self) -> Counts:
        return Counts(*self._ask("counts", self._directions))


class Host:
    """A computer of the network: a network, a host name, `/dev/shm` and COCORO directories of its own. The rest of the
    file system, users and processes are those of this machine. This process is not on it: zenoh sessions and all else
    that makes sockets in threads of its own need a process on the host."""

    def __init__(self, name: str, address: str, namespaces: Sequence[int], folder: Path) -> None:
        self.name = name
        self.address = address
        self._namespaces = tuple(namespaces)
        folder.mkdir(mode=0o700)
        self.folder = folder
        self.env = {}
        """What `run` adds to the environment of this process."""
        for variable, place in (("RUN", "run"), ("STATE", "state"), ("CAPTURE", "captures")):
            (folder / place).mkdir(mode=0o700)
            self.env[f"COCORO_{variable}_DIR"] = str(folder / place)
        # The system forks a process into the namespaces of the thread that starts it.
        self._thread = ThreadPoolExecutor(1, f"host {name}", linux.enter, (self._namespaces,))
        self._processes: list[subprocess.Popen[Any]] = []

    def run(
        self, argv: Sequence[str | Path], env: Mapping[str, str] | None = None, **options: Any
    ) -> subprocess.Popen[Any]:
        """Start a process on the host; `env` is added to its environment, `options` are those of Popen. It is ended
        with the network."""
        options.setdefault("cwd", Path.cwd())
        environment = {**os.environ, **self.env, **(env or {})}
        process = self.call(lambda: subprocess.Popen([*map(str, argv)], env=environment, **options))
        self._processes.append(process)
        return process

    def call(self, function: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
        """Call a function in a thread that is on the host. A socket that it makes stays on the host and may be used
        anywhere. Paths must be absolute. Calls of a host wait for one another."""
        return self._thread.submit(function, *args, **kwargs).result()

    def socket(self, kind: int = socket.SOCK_STREAM) -> socket.socket:
        """A new IPv4 socket on the host."""
        return self.call(socket.socket, socket.AF_INET, kind)

    @property
    def prefix(self) -> list[str]:
        """Words before a command line that have it run on the host, for those who cannot use `run`."""
        spaces = zip(("net", "mount", "uts"), self._namespaces, strict=True)
        options = [f"--{kind}=/proc/{os.getpid()}/fd/{space}" for kind, space in spaces]
        return ["nsenter", *options, "--wd=.", "--", "env", *(f"{k}={v}" for k, v in self.env.items())]

    def end(self) -> None:
        """Ask what `run` has started to end, kill what does not, and close the pipes to it."""
        for process in self._processes:
            process.terminate()
        for process in self._processes:
            child.wait_or_kill(process, END_S)
            for pipe in (process.stdin, process.stdout, process.stderr):
                with suppress(BrokenPipeError):  # what nobody has read
                    if pipe is not None:
                        pipe.close()
        self._processes.clear()

    def close(self) -> None:
        self._thread.shutdown()
        for namespace in self._namespaces:
            os.close(namespace)

    def kill_all(self) -> None:
        """Kill all processes on the host."""
        linux.kill_all(self._namespaces[:1], but=(os.getpid(),))


class Network:
    """A context manager: hosts that reach one another over links without delay, loss and limit until these are set.

    The first host has the address 10.77.0.1, the next one 10.77.0.2; on each host the names of all are known. Packets
    are forwarded between the hosts alone, IPv4 to one destination. At the end, and also when this process is killed,
    all processes on the hosts are killed and nothing is left.
    """

    def __init__(self, *hosts: str, mtu: int = 1500, seed: int = 0) -> None:
        """`mtu`: bytes of the largest packet, up to 65535. `seed`: which packets are lost, and the jitter. Raises
        CocoroError where no network is to be had, ValueError for names that cannot be."""
        if len(set(hosts)) < len(hosts) or not 1 <= len(hosts) <= MOST_HOSTS:
            raise ValueError(f"hosts {', '.join(hosts)}: give 1 to {MOST_HOSTS} different names")
        if wrong := [name for name in hosts if not _NAME.fullmatch(name) or name == "localhost"]:
            raise ValueError(f"{wrong[0]!r} is no name of a host: give lower-case letters, digits and hyphens")
        if not 576 <= mtu <= 65535:
            raise ValueError(f"mtu={mtu}: give 576 to 65535")
        if why := obstacle():
            raise CocoroError(why)
        self._names = hosts
        self._plan = {"mtu": mtu, "seed": seed}
        self._lock = threading.Lock()
        self._hosts: dict[str, Host] = {}
        self._folder: Path | None = None

    def __enter__(self) -> Network:
        addresses = {name: f"{NETWORK}.{number}" for number, name in enumerate(self._names, 1)}
        self._channel, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with theirs:
            self._switch = child.start(
                "sim.network.switch", str(theirs.fileno()), site_packages=False,
                env=child.environment_for(), pass_fds=(theirs.fileno(),),
            )  # fmt: skip
        linux.run_first(self._switch.pid)
        try:
            self._channel.send(json.dumps(self._plan | {"hosts": addresses}).encode())
            kinds = len(linux.KINDS)
            room = kinds * len(addresses)
            reply, spaces, _, _ = socket.recv_fds(self._channel, 65536, room, socket.MSG_CMSG_CLOEXEC)
            try:
                folder = self._folder = Path(self._read(reply))
            except ValueError as error:
                raise CocoroError(f"no network of hosts here: {error}") from error
            for number, (name, address) in enumerate(addresses.items()):
                own = spaces[number * kinds : (number + 1) * kinds]
                self._hosts[name] = Host(name, address, own, folder / name)
        except BaseException:
            self.__exit__()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        try:
            for host in self._hosts.values():
                host.end()
        finally:
            self._channel.close()  # the switch kills what is left on the hosts
            if self._switch.wait() != 0:  # it was killed itself
                for host in self._hosts.values():
                    host.kill_all()
            for host in self._hosts.values():
                host.close()
            if self._folder is not None:
                shutil.rmtree(self._folder, ignore_errors=True)

    def host(self, name: str) -> Host:
        return self._hosts[name]

    @property
    def switch_pid(self) -> int:
        """The process that forwards, to measure what it takes."""
        return self._switch.pid

    # --- links ----------------------------------------------------------------------------------------

    def link(self, a: str, b: str) -> Link:
        """Both directions between two hosts."""
        return self._chosen(lambda source, target: {source, target} == {a, b}, a, b)

    def direction(self, source: str, target: str) -> Link:
        """The direction from one host to another one."""
        return self._chosen(lambda one, other: (one, other) == (source, target), source, target)

    def links(self, *hosts: str) -> Link:
        """All links of these hosts, or all of the network."""
        return self._chosen(lambda source, target: not hosts or source in hosts or target in hosts, *hosts)

    def cut(self, *hosts: str, for_s: float | None = None) -> None:
        """Lose every packet to and from these hosts, or all, until `heal` or for a time."""
        self.links(*hosts).cut(for_s)

    def heal(self, *hosts: str) -> None:
        """End all cuts of these hosts, or all."""
        self.links(*hosts).heal()

    def _chosen(self, wanted: Callable[[str, str], bool], *named: str) -> Link:
        if unknown := {*named}.difference(self._names):
            raise KeyError(f"no host {', '.join(unknown)}; there are {', '.join(self._names)}")
        pairs = [
            (number, other)
            for number, source in enumerate(self._names)
            for other, target in enumerate(self._names)
            if number != other and wanted(source, target)
        ]
        if not pairs:
            raise ValueError(f"no link between {' and '.join(named)}")
        return Link(self._ask, pairs)

    def _ask(self, verb: str, directions: Sequence[tuple[int, int]], values: Mapping[str, Any] | None = None) -> Any:
        with self._lock:
            try:
                self._channel.send(json.dumps({"do": verb, "directions": directions, "values": values or {}}).encode())
                reply = self._channel.recv(65536)
            except ConnectionError:
                reply = b""
            return self._read(reply)

    @staticmethod
    def _read(reply: bytes) -> Any:
        if not reply:
            raise CocoroError("the switch of the network has ended; its standard error says why")
        answer = json.loads(reply)
        if isinstance(answer, dict):
            raise ValueError(answer["error"])
        return answer
