"""Who was refused what, from lines as zenoh 1.10 logs them."""

from __future__ import annotations

import os
import threading
import tracemalloc
from collections.abc import Iterable

import pytest

from deploy.site.refusals import LONGEST_LINE, READ_BYTES, VERDICTS, Refusal, Sifter, whole_lines

HEAD = b"2026-11-30T20:06:21.826161Z TRACE  rx-%d ThreadId(%02d) zenoh::net::routing::interceptor::access_control: "
EVE = b"bb63 on Interface(lo)+CertCommonName(eve.1)+Transport(Tls)+bb63"
KINDS = (
    "Query", "Reply", "Put", "Delete", "Declare/Undeclare Subscriber", "Declare/Undeclare Queryable",
    "Declare/Undeclare Liveliness Token", "Liveliness Query", "Declare Liveliness Subscriber",
)  # fmt: skip


def line(text: bytes, thread: int = 1) -> bytes:
    return HEAD % (thread, thread) + text


def told(*lines: bytes) -> list[Refusal | str]:
    return list(Sifter().sift(b"\n".join(lines)))


def test_what_somebody_tried_is_told_with_his_name_and_the_key() -> None:
    assert told(
        line(EVE + b" is unauthorized to Put (ingress) on r/base/command"),
        line(EVE + b" is authorized to Declare Subscriber (ingress) on r/**"),
        line(b"Using cached result: bb63 is unauthorized to Query (ingress) on r/executive/run"),
    ) == [Refusal("eve.1", "Put", "r/base/command"), Refusal("bb63", "Query", "r/executive/run")]


def test_what_is_kept_from_somebody_or_ends_is_no_attempt() -> None:
    assert not told(
        line(EVE + b" is unauthorized to Put (egress) on r/sim/truth"),
        line(EVE + b" is unauthorized to Undeclare Subscriber (ingress) on Some(ke`r/sim/truth`)"),
    )


def test_what_zenoh_computes_in_advance_for_a_key_is_no_attempt() -> None:
    computed = [line(EVE + f" is unauthorized to {kind} (ingress) on r/q".encode()) for kind in KINDS]
    assert len(computed) == VERDICTS
    other = line(EVE + b" is unauthorized to Put (ingress) on r/meanwhile", thread=2)
    attempt = line(EVE + b" is unauthorized to Put (ingress) on r/q")
    begun = line(b"ACL (ingress): caching permissions for `r/q` ...")
    assert told(begun, *computed[:4], other, *computed[4:], attempt) == [
        Refusal("eve.1", "Put", "r/meanwhile"),
        Refusal("eve.1", "Put", "r/q"),
    ]


def test_a_line_may_come_in_two_parts_of_a_computation() -> None:
    sifter = Sifter()
    assert not list(sifter.sift(line(b"ACL (ingress): caching permissions for `r/q` ...")))
    assert not list(sifter.sift(line(EVE + b" is unauthorized to Put (ingress) on r/q")))


@pytest.mark.parametrize(
    "reason",
    [
        "invalid peer certificate: certificate expired: verification time 1796068317 (UNIX)",
        "peer sent no certificates",
        "received fatal alert: UnknownCA",
    ],
)
def test_who_is_not_let_in_has_no_name_and_a_reason(reason: str) -> None:
    warned = (
        f"2026-11-30T19:51:57Z  WARN acc-0 ThreadId(04) zenoh_link_tls::unicast: {reason}. Hint: increase the limit."
    )
    assert told(warned.encode()) == [Refusal("", reason)]


def test_other_warnings_are_passed_on_and_all_else_is_left_out() -> None:
    odd = b"2026-11-30T19:51:57Z ERROR net-0 ThreadId(04) zenoh::net::runtime: something else"
    assert told(b"2026-11-30T19:51:57Z  INFO nothing", odd, b"", b"\xff") == [odd.decode()]


def piped(parts: Iterable[bytes]) -> list[bytes]:
    """What `whole_lines` makes of these parts, each written to the pipe at once."""
    read_fd, write_fd = os.pipe()

    def write() -> None:
        with os.fdopen(write_fd, "wb", buffering=0) as end:
            for part in parts:
                end.write(part)

    thread = threading.Thread(target=write)
    thread.start()
    try:
        with os.fdopen(read_fd, "rb", buffering=0) as pipe:
            return list(whole_lines(pipe))
    finally:
        thread.join()


def test_lines_come_whole_however_the_log_arrives() -> None:
    """Some lines are in two parts, and all of them are more than one reading takes."""
    lines = [b"%06d %s" % (number, b"x" * (number % 700)) for number in range(2000)]
    log = b"\n".join(lines) + b"\n"
    assert len(log) > 3 * READ_BYTES
    parts = (log[at : at + 4099] for at in range(0, len(log), 4099))
    assert b"\n".join(piped(parts)) == b"\n".join(lines)


def test_of_an_endless_line_the_beginning_counts() -> None:
    endless = b"begun " + b"x" * (3 * READ_BYTES)
    assert b"\n".join(piped([endless, b"\n", b"next\n"])).split(b"\n")[0].startswith(b"begun ")
    assert b"\n".join(piped([endless, b"\nnext\n"])).endswith(b"\nnext")
    assert max(map(len, piped([endless, b"\n"]))) < LONGEST_LINE + READ_BYTES


def test_reading_the_log_takes_no_new_buffer_each_time() -> None:
    """Buffers of a megabyte, one for each reading, made a gateway grow by 25 MB in its first 90 s."""
    parts = [line(b"a line of the log\n")] * 30
    tracemalloc.start()
    try:
        read = piped(parts)
        _, peak_bytes = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert b"\n".join(read).count(b"a line of the log") == len(parts)
    assert peak_bytes < 2 * READ_BYTES
