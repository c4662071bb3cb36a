"""A link that carries more than it may is held back, loses nothing, and is let go again."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from contextlib import closing

import pytest

from cocoro.bus.router import LEASE_S, Link
from deploy.site import throttle
from deploy.site.throttle import (
    ALLOWED_BYTES_S,
    PERIOD_S,
    SAVED_S,
    SLOW_BYTES,
    Throttle,
    buffer_of,
    hold,
    let_go,
    received,
    sockets,
)

PATIENCE_S = 60.0
SLOW_BYTES_S = 3e7
"""About what a link with a small buffer carries between two programs of one machine."""
Pair = tuple[socket.socket, socket.socket]


@pytest.fixture
def pair() -> Iterator[Pair]:
    """A TCP connection: the end that sends, and the end that was accepted."""
    with (
        socket.create_server(("127.0.0.1", 0)) as server,
        socket.create_connection(server.getsockname()) as sender,
        closing(server.accept()[0]) as taken,
    ):
        taken.settimeout(PATIENCE_S)
        yield sender, taken


def link_of(sender: socket.socket) -> Link:
    host, port = sender.getsockname()
    return Link("1a", "eve.1", f"tls/{host}:{port}")


def test_sockets_are_found_by_the_address_at_their_other_end(pair: Pair) -> None:
    sender, taken = pair
    found = sockets()
    assert found[sender.getsockname()].getsockname() == taken.getsockname()
    for one in found.values():
        one.close()
    sender.sendall(b"still")
    assert taken.recv(5) == b"still", "only duplicates were closed"


def test_what_is_sent_to_a_held_socket_comes_when_it_is_let_go(pair: Pair) -> None:
    sender, taken = pair
    sender.sendall(b"before")
    assert taken.recv(6, socket.MSG_WAITALL) == b"before"
    hold(taken)
    sender.sendall(b"meanwhile")
    taken.sendall(b"the other way")
    assert sender.recv(13, socket.MSG_WAITALL) == b"the other way"
    assert received(taken) == len(b"before")
    taken.setblocking(False)
    with pytest.raises(BlockingIOError):
        taken.recv(1)
    taken.settimeout(PATIENCE_S)
    let_go(taken)
    assert taken.recv(9, socket.MSG_WAITALL) == b"meanwhile"


class Watching:
    """A throttle on one link whose bytes the test counts."""

    def __init__(self, pair: Pair, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now_s = 100.0
        self.bytes = 0.0
        self.told: list[Link] = []
        self.held = False
        self.buffers: list[int] = []
        monkeypatch.setattr(throttle, "received", lambda _: int(self.bytes))
        monkeypatch.setattr(throttle, "set_buffer", lambda _, size: self.buffers.append(size))
        monkeypatch.setattr(throttle, "hold", lambda _: self._hold(held=True))
        monkeypatch.setattr(throttle, "let_go", lambda _: self._hold(held=False))
        self.throttle = Throttle(self.told.append)
        self.link, self.end = link_of(pair[0]), pair[1]
        self.throttle.follow([self.link])
        self.throttle.look(self.now_s)

    def _hold(self, *, held: bool) -> None:
        assert self.held != held
        self.held = held

    def passes(self, seconds: float, bytes_s: float) -> None:
        """Time passes, while a link that is not held carries so much."""
        for _ in range(round(seconds / PERIOD_S)):
            self.now_s += PERIOD_S
            if not self.held:
                slow = self.buffers and self.buffers[-1] == SLOW_BYTES
                self.bytes += (min(bytes_s, SLOW_BYTES_S) if slow else bytes_s) * PERIOD_S
            self.throttle.look(self.now_s)


@pytest.fixture
def watching(pair: Pair, monkeypatch: pytest.MonkeyPatch) -> Iterator[Watching]:
    found = Watching(pair, monkeypatch)
    yield found
    found.throttle.close()


def test_who_stays_within_the_allowance_is_never_held(watching: Watching) -> None:
    watching.passes(10.0, 0.9 * ALLOWED_BYTES_S)
    watching.passes(SAVED_S, 0.0)
    watching.bytes += 0.9 * SAVED_S * ALLOWED_BYTES_S  # at once
    watching.passes(1.0, 0.0)
    assert not watching.told


@pytest.mark.parametrize("bytes_s", [2e7, 1e9])
def test_who_floods_gets_no_more_than_the_allowance_and_is_told_of_once(watching: Watching, bytes_s: float) -> None:
    seconds = 60.0
    watching.passes(seconds, bytes_s)
    assert watching.told == [watching.link]
    unseen = bytes_s * PERIOD_S  # before the first look at a link that floods
    assert 0.8 < (watching.bytes - unseen) / (ALLOWED_BYTES_S * seconds) < 1.1
    watching.passes(60.0, 0.0)
    assert not watching.held, "it may speak again"
    assert watching.buffers == [SLOW_BYTES, buffer_of(watching.end) // 2]


def test_no_moment_is_as_long_as_a_link_may_be_silent(watching: Watching) -> None:
    longest_s = 0.0
    watching.bytes += 1e12
    for _ in range(1000):
        watching.passes(PERIOD_S, 1e9)
        longest_s = longest_s + PERIOD_S if watching.held else 0.0
        assert longest_s < LEASE_S / 2


def test_a_link_that_has_gone_is_forgotten(watching: Watching) -> None:
    while not watching.held:
        watching.passes(PERIOD_S, 1e9)
    watching.throttle.follow([])
    watching.passes(100.0, 0.0)
    assert watching.held, "nobody touches its socket any more"
    assert watching.told == [watching.link]


def test_who_links_anew_has_the_allowance_that_he_had(watching: Watching) -> None:
    watching.passes(0.2, 1e9)
    seconds, before = 20.0, watching.bytes
    for _ in range(round(seconds)):
        watching.throttle.follow([])
        watching.held = False
        watching.throttle.follow([watching.link])
        watching.passes(1.0, 2e7)
    assert watching.bytes - before < 1.3 * ALLOWED_BYTES_S * seconds
    assert watching.told == [watching.link]


def test_a_link_without_a_socket_here_is_left_alone() -> None:
    told: list[Link] = []
    alone = Throttle(told.append)
    alone.follow([Link("2b", "eve.1", "tls/[fe80::1]:7447"), Link("3c", "eve.1", "quic/10.0.0.1")])
    alone.look(1.0)
    alone.look(2.0)
    assert not told
