"""Who was refused what, from lines as zenoh 1.10 logs them."""

from __future__ import annotations

import pytest

from deploy.site.refusals import VERDICTS, Refusal, Sifter

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
