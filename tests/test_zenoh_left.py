"""What sessions that have gone leave in a zenoh router. A new version of zenoh that forgets them is noticed here."""

from __future__ import annotations

import ctypes
import subprocess
import sys
from pathlib import Path

import pytest
from bare_zenoh import LOCAL, opened

pytestmark = [pytest.mark.zenoh, pytest.mark.process]


class Allocated(ctypes.Structure):
    """`struct mallinfo2` of the C library; mallinfo(3)."""

    _fields_ = [(name, ctypes.c_size_t) for name in (
        "arena", "ordblks", "smblks", "hblks", "hblkhd", "usmblks", "fsmblks", "uordblks", "fordblks", "keepcost",
    )]  # fmt: skip


def in_use_bytes() -> int:
    """Bytes that this process has allocated and not freed."""
    mallinfo = ctypes.CDLL(None).mallinfo2
    mallinfo.restype = Allocated
    return int(mallinfo().uordblks)


LEAVERS = """
import sys
sys.path[:0] = {path!r}
from bare_zenoh import opened
for _ in range({count}):
    session = opened("client", [], [{end!r}], {{}})
    subscriber = session.declare_subscriber({keyexpr!r}, print)
    list(session.liveliness().get("r/none", timeout=5.0))
    session.close()
"""


def left_bytes(end: str, keyexpr: str, count: int) -> float:
    """What each of so many sessions that subscribe to an expression leaves in this process."""
    program = LEAVERS.format(path=sys.path, count=count, end=end, keyexpr=keyexpr)
    before = in_use_bytes()
    subprocess.run([sys.executable, "-c", program], check=True, timeout=50)
    return (in_use_bytes() - before) / count


def test_who_subscribes_to_the_wildcards_of_somebody_who_stays_is_never_forgotten(tmp_path: Path) -> None:
    """zenoh 1.10 keeps a session that has gone in each wildcard expression that another has declared too. If this
    fails, the recorder need not have an expression of its own."""
    end = f"{LOCAL}/{tmp_path}/router.sock"
    router = opened("router", [end], [], {})
    stays = opened("client", [], [end], {})
    try:
        with stays.declare_subscriber("r/**", lambda _: None):
            left_bytes(end, "r/*/**", 40)  # what a router makes once, and keeps
            other = left_bytes(end, "r/*/**", 60)
            same = left_bytes(end, "r/**", 60)
        assert same > other + 1000
    finally:
        for session in (stays, router):
            session.close()  # type: ignore[no-untyped-call]
