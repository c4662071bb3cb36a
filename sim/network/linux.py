"""The system calls behind hosts: namespaces, TUN devices, addresses. They run no program, so none must be installed."""

from __future__ import annotations

import ctypes
import fcntl
import os
import signal
import socket
import struct
import threading
import time
from collections.abc import Callable, Collection
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

_NEW_FS, _NEW_MOUNTS, _NEW_NAME, _NEW_NETWORK = 0x200, 0x20000, 0x4000000, 0x40000000
"""CLONE_FS, CLONE_NEWNS, CLONE_NEWUTS, CLONE_NEWNET: unshare(2)."""
_BIND, _RECURSIVE, _PRIVATE = 0x1000, 0x4000, 0x40000
"""MS_BIND, MS_REC, MS_PRIVATE: mount(2)."""
_TUN, _NO_HEADER, _SET_TUN = 0x1, 0x1000, 0x400454CA
"""IFF_TUN, IFF_NO_PI, TUNSETIFF: Documentation/networking/tuntap.rst."""
_SET_FLAGS, _SET_ADDRESS, _SET_MASK, _SET_MTU, _SET_QUEUE = 0x8914, 0x8916, 0x891C, 0x8922, 0x8943
_UP_AND_RUNNING = 0x41
"""IFF_UP and IFF_RUNNING: netdevice(7)."""
_TIMER_SLACK = 29
"""PR_SET_TIMERSLACK: prctl(2)."""
DEVICE = "net0"
DEVICE_PACKETS = 10_000
"""Packets that may wait for the switch at a device."""
KINDS = {"net": _NEW_NETWORK, "mnt": _NEW_MOUNTS, "uts": _NEW_NAME}
KILL_S = 5.0
"""Longest wait for killed processes to be gone."""

_libc = ctypes.CDLL(None, use_errno=True)


def _check(result: int, what: str) -> None:
    if result:
        number = ctypes.get_errno()
        raise OSError(number, f"{what}: {os.strerror(number)}")


class Made(NamedTuple):
    """Descriptors of a host: the switch's end of its device, and its namespaces in the order of KINDS."""

    device: int
    namespaces: tuple[int, ...]


def in_thread(work: Callable[[], Made]) -> Made:
    """Run work in a thread that ends, and whose namespaces are not those of this process."""
    results: list[Made] = []
    errors: list[OSError] = []

    def run() -> None:
        try:
            results.append(work())
        except OSError as error:
            errors.append(error)

    thread = threading.Thread(target=run)
    thread.start()
    thread.join()
    for error in errors:
        raise error
    return results[0]


def make_host(name: str, address: str, mtu: int, names: Path | None = None) -> Made:
    """Move this thread into new namespaces, and give them a device with an address in a network of /24. `names`: a file
    that takes the place of /etc/hosts. The namespaces stay as long as a descriptor or a process has them."""
    _check(_libc.unshare(_NEW_NETWORK | _NEW_MOUNTS | _NEW_NAME), "unshare")
    socket.sethostname(name)
    _check(_libc.mount(None, b"/", None, _RECURSIVE | _PRIVATE, None), "mount /")
    # Hosts share no memory: zenoh would pass frames through it, past the network.
    _check(_libc.mount(b"tmpfs", b"/dev/shm", b"tmpfs", 0, b"mode=1777"), "mount /dev/shm")
    if names is not None and Path("/etc/hosts").exists():
        _check(_libc.mount(os.fsencode(names), b"/etc/hosts", None, _BIND, None), "mount /etc/hosts")
    with suppress(OSError):  # a kernel without IPv6; the switch forwards IPv4 only
        Path("/proc/sys/net/ipv6/conf/default/disable_ipv6").write_text("1")
    device = os.open("/dev/net/tun", os.O_RDWR | os.O_NONBLOCK | os.O_CLOEXEC)
    try:
        _set_up(device, address, mtu)
    except OSError:
        os.close(device)
        raise
    spaces = [os.open(f"/proc/thread-self/ns/{kind}", os.O_RDONLY | os.O_CLOEXEC) for kind in KINDS]
    return Made(device, tuple(spaces))


def _set_up(device: int, address: str, mtu: int) -> None:
    fcntl.ioctl(device, _SET_TUN, _request(DEVICE, struct.pack("=H", _TUN | _NO_HEADER)))
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as control:

        def tell(call: int, value: bytes, to: str = DEVICE) -> None:
            fcntl.ioctl(control, call, _request(to, value))

        tell(_SET_ADDRESS, _ip(address))
        tell(_SET_MASK, _ip("255.255.255.0"))
        tell(_SET_MTU, struct.pack("=i", mtu))
        tell(_SET_QUEUE, struct.pack("=i", DEVICE_PACKETS))
        for name_of_device in (DEVICE, "lo"):
            tell(_SET_FLAGS, struct.pack("=H", _UP_AND_RUNNING), name_of_device)


def _request(device: str, value: bytes) -> bytes:
    """A `struct ifreq`."""
    return struct.pack("=16s24s", device.encode(), value)


def _ip(address: str) -> bytes:
    """A `struct sockaddr_in`."""
    return struct.pack("=HH4s8x", socket.AF_INET, 0, socket.inet_aton(address))


def enter(namespaces: Collection[int]) -> None:
    """Move this thread, and no other one, into namespaces in the order of KINDS."""
    _check(_libc.unshare(_NEW_FS), "unshare")
    for descriptor, kind in zip(namespaces, KINDS.values(), strict=True):
        _check(_libc.setns(descriptor, kind), "setns")


def run_first(pid: int) -> None:
    """Have a process run before those that it forwards for: a real network does not wait for the processors of its
    hosts."""
    with suppress(OSError):  # not allowed in some containers
        os.sched_setscheduler(pid, os.SCHED_RR, os.sched_param(1))


def be_punctual() -> None:
    """Wake this process to the microsecond also where it may not run first."""
    _libc.prctl(_TIMER_SLACK, 1, 0, 0, 0)


def kill_all(networks: Collection[int], but: Collection[int]) -> None:
    """Kill every process whose network namespace is one of these descriptors'."""
    inodes = {os.fstat(descriptor).st_ino for descriptor in networks}
    end_s = time.monotonic() + KILL_S
    while found := [pid for pid in _processes() if pid not in but and _network_of(pid) in inodes]:
        for pid in found:
            with suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        if time.monotonic() > end_s:
            return
        time.sleep(0.005)


def _processes() -> list[int]:
    return [int(name) for name in os.listdir("/proc") if name.isdecimal()]  # noqa: PTH208  as below


def _network_of(pid: int) -> int:
    try:
        return os.stat(f"/proc/{pid}/ns/net").st_ino  # noqa: PTH116  pathlib is slower, and there are many
    except OSError:  # it has ended
        return 0
