"""What this project builds on in zenoh's router mode. A new version of zenoh that changes one of these is noticed here.

One router with mutual TLS, access rules, limits of sizes and rates; a peer on a Unix socket as the processes of a host
are; clients with certificates. All on this machine.
"""

from __future__ import annotations

import json
import socket
import threading
import time
from collections.abc import Callable, Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest
import zenoh
from bare_zenoh import LOCAL, opened
from operator_shell import PATIENCE_S
from zenoh.handlers import Callback

from deploy.site import authority, credentials, place

pytestmark = pytest.mark.zenoh

EVERYTHING = [
    "put", "delete", "declare_subscriber", "query", "reply", "declare_queryable",
    "liveliness_token", "liveliness_query", "declare_liveliness_subscriber",
]  # fmt: skip
STUCK_S = 10.0
"""For so long at most a client takes nothing."""
SECOND_S = 1.0
ENOUGH_TO_STALL = 40
"""Samples of 1 MB: more than the sockets and queues between two sessions take."""


def until(condition: Callable[[], object], what: str) -> None:
    deadline_s = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < deadline_s, what
        time.sleep(0.005)


def send(session: zenoh.Session, *keys: str, size: int = 0) -> None:
    """Publish on each key. A busy machine delays the samples, and loses none."""
    for key in keys:
        session.put(key, bytes(size), congestion_control=zenoh.CongestionControl.BLOCK)


class Room:
    """A router between a peer on a Unix socket and clients with certificates."""

    def __init__(self, folder: Path, options: dict[str, Any]) -> None:
        self.folder = folder
        self.heard: list[str] = []
        self._lock = threading.Lock()
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            port = probe.getsockname()[1]
        self.endpoint = f"tls/127.0.0.1:{port}"
        end = f"{LOCAL}/{folder}/peer.sock"
        self.peer = opened("peer", [end], [], {})
        self.router = opened("router", [self.endpoint], [end], {**self.tls("router"), **options})
        until(lambda: self.router.info.peers_zid(), "the router is linked with the peer")
        self._sessions = [self.router, self.peer]

    def hear(self) -> None:
        """Have the peer hear everything."""
        self.subscriber = self.peer.declare_subscriber("r/**", self._on_sample)

    def _on_sample(self, sample: zenoh.Sample) -> None:
        with self._lock:
            self.heard.append(str(sample.key_expr))

    def tls(self, name: str) -> dict[str, Any]:
        folder = self.folder / place.CREDENTIALS / name
        return credentials.read(folder, datetime.now(UTC)).options

    def client(self, name: str) -> zenoh.Session:
        session = opened("client", [], [self.endpoint], self.tls(name))
        self._sessions.insert(0, session)
        return session

    def heard_from(self, client: zenoh.Session, key: str) -> int:
        """How often a key was heard by the peer, counted when what the client sent last has arrived."""
        mark = f"r/mark/{time.monotonic_ns()}"
        send(client, mark)
        until(lambda: mark in self.heard, f"{mark} arrives")
        return self.heard.count(key)

    def close(self) -> None:
        for session in self._sessions:
            session.close()  # type: ignore[no-untyped-call]


@pytest.fixture
def issued(tmp_path: Path) -> Path:
    now = datetime.now(UTC)
    authority.init(tmp_path, now)
    authority.issue(tmp_path, "robot", "router", now, addresses=["127.0.0.1"])
    for name in ("ada", "eve"):
        authority.issue(tmp_path, "operator", name, now)
    return tmp_path


@pytest.fixture
def room(issued: Path, request: pytest.FixtureRequest) -> Iterator[Room]:
    made = Room(issued, getattr(request, "param", {}))
    made.hear()
    yield made
    made.close()


def allowing(*rules: tuple[str, list[str], list[str], list[str]], default: str = "deny") -> dict[str, Any]:
    """Access control: `rules` are the certificate's name, flows, messages and keys that it allows."""
    made = [
        {"id": f"{index}", "permission": "allow", "flows": flows, "messages": messages, "key_exprs": keys}
        for index, (_, flows, messages, keys) in enumerate(rules)
    ]
    local = {"id": "local", "permission": "allow", "flows": ["ingress", "egress"], "messages": EVERYTHING}
    return {
        "access_control": {
            "enabled": True,
            "default_permission": default,
            "rules": [{**local, "key_exprs": ["**"]}, *made],
            "subjects": [
                {"id": "local", "link_protocols": [LOCAL]},
                *({"id": f"s{index}", "cert_common_names": [rule[0]]} for index, rule in enumerate(rules)),
            ],
            "policies": [
                {"rules": ["local"], "subjects": ["local"]},
                *({"rules": [f"{index}"], "subjects": [f"s{index}"]} for index in range(len(rules))),
            ],
        }
    }


ADA_PUTS = ("ada.1", ["ingress"], ["put"], ["r/open", "r/mark/*"])


@pytest.mark.parametrize("room", [allowing(ADA_PUTS)], indirect=True)
def test_a_router_denies_by_default_and_knows_who_sends_by_the_certificates_name(room: Room) -> None:
    ada, eve = room.client("ada"), room.client("eve")
    send(eve, "r/open")
    send(ada, "r/open", "r/closed")
    assert room.heard_from(ada, "r/open") == 1
    assert "r/closed" not in room.heard
    names = {link.auth_identifier for link in room.router.info.links()}
    assert {"ada.1", "eve.1"} <= names, "a link tells the certificate's name"


@pytest.mark.parametrize(
    "room", [allowing(ADA_PUTS, ("ada.1", ["ingress"], ["declare_subscriber"], ["r/told"]))], indirect=True
)
def test_rules_are_needed_in_both_directions(room: Room) -> None:
    ada = room.client("ada")
    got: list[str] = []
    with ada.declare_subscriber("r/told", lambda sample: got.append(str(sample.key_expr))):
        assert room.heard_from(ada, "r/told") == 0
        room.peer.put("r/told", b"")
        assert room.heard_from(ada, "r/told") == 1
    assert got == [], "it may subscribe, and nothing may go out to it"


@pytest.mark.parametrize(
    "room",
    [allowing(ADA_PUTS, ("ada.1", ["ingress", "egress"], ["declare_subscriber", "put"], ["r/one", "r/two/*"]))],
    indirect=True,
)
def test_a_wildcard_subscription_passes_only_where_a_rule_includes_all_of_it(room: Room) -> None:
    ada = room.client("ada")
    got: list[str] = []
    with (
        ada.declare_subscriber("r/**", lambda sample: got.append(f"all {sample.key_expr}")),
        ada.declare_subscriber("r/two/*", lambda sample: got.append(f"two {sample.key_expr}")),
    ):
        room.heard_from(ada, "r/one")
        room.peer.put("r/one", b"")
        room.peer.put("r/two/x", b"")
        until(lambda: "two r/two/x" in got, "it arrives")
    assert "all r/one" not in got, "the wide one was refused"


@pytest.mark.parametrize("room", [allowing(("ada.1", ["ingress", "egress"], EVERYTHING, ["**"]))], indirect=True)
def test_no_wildcard_of_a_rule_covers_a_key_with_a_verbatim_chunk(room: Room) -> None:
    ada = room.client("ada")
    with ada.liveliness().declare_token("@own/token"), ada.liveliness().declare_token("r/token"):
        until(lambda: list(room.peer.liveliness().get("r/token", timeout=SECOND_S)), "the other token is known")
        assert not list(room.peer.liveliness().get("@own/token", timeout=SECOND_S))


LIMITS = {
    "low_pass_filter": [
        {"id": "size", "link_protocols": ["tls"], "flows": ["ingress"], "messages": ["put"], "key_exprs": ["r/small"],
         "size_limit": 100_000}
    ],
    "downsampling": [
        {"id": "rate", "link_protocols": ["tls"], "flows": ["ingress"], "messages": ["put"],
         "rules": [{"key_expr": "r/slow", "freq": 0.01}]}
    ],
}  # fmt: skip


@pytest.mark.parametrize("room", [LIMITS], indirect=True)
def test_sizes_and_rates_are_limited_where_a_message_comes_in(room: Room) -> None:
    ada = room.client("ada")
    send(ada, "r/small", size=1_500_000)
    send(ada, "r/small", size=90_000)
    for _ in range(20):
        send(ada, "r/slow", "r/fast")
    assert room.heard_from(ada, "r/small") == 1
    assert room.heard.count("r/slow") == 1, "one in a hundred seconds"
    assert room.heard.count("r/fast") == 20, "other keys are not slowed down"


QUESTIONS = {
    "downsampling": [
        {"id": "rate", "link_protocols": ["tls"], "flows": ["ingress"], "messages": ["query"],
         "rules": [{"key_expr": "r/stop", "freq": 0.01}]}
    ],
}  # fmt: skip


@pytest.mark.parametrize("room", [QUESTIONS], indirect=True)
def test_who_asks_too_often_has_nobody_elses_questions_dropped(room: Room) -> None:
    """A flood of stops on one link must not deny the stop of another person."""
    asked: list[str] = []

    def answer(query: zenoh.Query) -> None:
        with query:
            asked.append(str(query.payload))
            query.reply("r/stop", b"stopped")

    with room.peer.declare_queryable("r/stop", answer):
        eve, ada = room.client("eve"), room.client("ada")
        until(lambda: list(eve.get("r/stop", payload="", timeout=0.2)), "the first of a link passes")
        for _ in range(50):
            assert not list(eve.get("r/stop", payload="", timeout=0.02)), "one in a hundred seconds"
        assert list(ada.get("r/stop", payload="", timeout=SECOND_S)), "another link has its own limit"
    assert len(asked) == 2


EVENTS = {
    "qos/network": [
        {"id": "events", "link_protocols": ["tls"], "flows": ["egress"], "messages": ["put"],
         "key_exprs": ["r/*/event"], "overwrite": {"congestion_control": "drop"}}
    ]
}  # fmt: skip


@pytest.mark.parametrize("room", [EVENTS], indirect=True)
def test_an_event_is_put_to_wait_for_no_link_where_a_router_says_so(room: Room) -> None:
    got: dict[str, Any] = {}

    def on_sample(sample: zenoh.Sample) -> None:
        got[str(sample.key_expr)] = sample.congestion_control

    block = zenoh.CongestionControl.BLOCK
    ada = room.client("ada")
    with ada.declare_subscriber("r/**", on_sample), room.peer.declare_publisher("r/x/event") as publisher:
        until(lambda: publisher.matching_status.matching, "the client is known")  # type: ignore[attr-defined]

        def both_arrive() -> bool:  # what waits for no link may be dropped
            for key in ("r/x/event", "r/x/other"):
                room.peer.put(key, b"", congestion_control=block)
            return len(got) == 2

        until(both_arrive, "both arrive")
    assert got == {"r/x/event": zenoh.CongestionControl.DROP, "r/x/other": block}


@pytest.mark.parametrize("room", [EVENTS], indirect=True)
def test_who_takes_nothing_from_a_router_keeps_no_event_from_others(room: Room) -> None:
    """A client that does not read its socket: without the rule the router's thread would wait for it."""
    ada, eve = room.client("ada"), room.client("eve")
    stuck, heard = threading.Event(), threading.Event()

    def on_ada(_: zenoh.Sample) -> None:
        stuck.wait(STUCK_S)

    def on_eve(sample: zenoh.Sample) -> None:
        if str(sample.key_expr) == "r/last":
            heard.set()

    with (
        ada.declare_subscriber("r/x/event", Callback(on_ada, indirect=False)),
        eve.declare_subscriber("r/last", Callback(on_eve, indirect=False)),
        room.peer.declare_publisher("r/last") as last,
        room.peer.declare_publisher("r/x/event", congestion_control=zenoh.CongestionControl.BLOCK) as events,
    ):
        for publisher in (last, events):
            until(lambda of=publisher: of.matching_status.matching, "the client is known")  # type: ignore[misc]
        for _ in range(ENOUGH_TO_STALL):
            events.put(bytes(1_000_000))
        last.put(b"")
        assert heard.wait(STUCK_S / 2)
        stuck.set()


def test_an_answer_has_the_priority_of_its_question(issued: Path) -> None:
    """Frames are answers: they must not go before commands."""
    room = Room(issued, {})
    ada = room.client("ada")
    data = bytes(600_000)
    try:
        with room.peer.declare_queryable("r/frame", lambda query: answered(query, data)):
            drop = zenoh.CongestionControl.DROP
            how: dict[str, Any] = {"priority": zenoh.Priority.BACKGROUND, "congestion_control": drop}

            answers: list[zenoh.Sample] = []

            def answered_now() -> bool:  # an answer may be dropped
                replies: Any = ada.get("r/frame", timeout=SECOND_S, **how)
                answers.extend(reply.ok for reply in replies if reply.ok is not None)
                return bool(answers)

            until(answered_now, "it is answered")
            sample = answers[0]
            assert len(sample.payload) == len(data)
            assert {"priority": sample.priority, "congestion_control": sample.congestion_control} == how
    finally:
        room.close()


def answered(query: zenoh.Query, data: bytes) -> None:
    with query:
        query.reply("r/frame", data)


@pytest.mark.parametrize(
    "room",
    [allowing(ADA_PUTS) | {"adminspace": {"enabled": True, "permissions": {"read": True, "write": True}}}],
    indirect=True,
)
def test_rules_cannot_change_while_a_router_runs(room: Room) -> None:
    """If this fails, the gateway need not open its router anew when the site changes."""
    ada = room.client("ada")
    place = f"@/{room.router.zid()}/router/config/access_control"
    room.peer.put(f"{place}/default_permission", json.dumps("allow"))
    room.peer.put(f"{place}/enabled", json.dumps(False))
    send(room.peer, "r/after")
    send(ada, "r/closed")
    room.heard_from(ada, "r/open")
    assert "r/closed" not in room.heard


def test_plugins_do_not_load_and_nothing_says_so(tmp_path: Path) -> None:
    session = opened("router", [], [], {"plugins/storage_manager": {"__required__": True}})
    try:
        assert not list(session.get(f"@/{session.zid()}/router/status/plugins/**", timeout=0.2))
    finally:
        session.close()  # type: ignore[no-untyped-call]


def test_a_router_opens_without_those_whom_it_connects_to_and_finds_them_later(issued: Path) -> None:
    room = Room(issued, {})
    room.close()
    retry = {"connect/retry": {"period_init_ms": 50, "period_max_ms": 100, "period_increase_factor": 2}}
    early = opened("router", [], [room.endpoint], {**room.tls("ada"), **retry})
    late = opened("router", [room.endpoint], [], room.tls("router"))
    until(lambda: [link.auth_identifier for link in early.info.links()] == ["router.1"], "it finds the other")
    early.close()  # type: ignore[no-untyped-call]
    late.close()  # type: ignore[no-untyped-call]


def test_two_cliques_of_peers_joined_by_two_routers_hear_everything_once(issued: Path) -> None:
    room = Room(issued, {})
    end = f"{LOCAL}/{issued}/far.sock"
    far = opened("peer", [end], [], {})
    gateway = opened("router", [], [end, room.endpoint], room.tls("ada"))
    got: list[str] = []
    try:
        with far.declare_subscriber("r/**", lambda sample: got.append(str(sample.key_expr))):
            publisher = room.peer.declare_publisher("r/x")
            until(lambda: publisher.matching_status.matching, "the far peer is known")  # type: ignore[attr-defined]
            for key in ("r/x", "r/y", "r/end"):
                room.peer.put(key, b"")
            until(lambda: "r/end" in got, "it arrives")
            assert got == ["r/x", "r/y", "r/end"]
    finally:
        for session in (gateway, far):
            session.close()  # type: ignore[no-untyped-call]
        room.close()


def test_who_has_no_good_certificate_is_not_let_in(issued: Path, tmp_path: Path) -> None:
    room = Room(issued, {})
    now = datetime.now(UTC)
    (foreign := tmp_path / "foreign").mkdir(mode=0o700)
    authority.init(foreign, now)
    authority.issue(foreign, "operator", "ada", now)
    stranger = credentials.read(foreign / place.CREDENTIALS / "ada", now).options
    none = {"transport/link/tls/root_ca_certificate": room.tls("ada")["transport/link/tls/root_ca_certificate"]}
    try:
        for options in (stranger, none):
            with pytest.raises(zenoh.ZError):
                opened("client", [], [room.endpoint], {**options, "connect/timeout_ms": 500})
    finally:
        room.close()


def test_a_router_asks_for_user_and_password(issued: Path) -> None:
    words = issued / "words"
    words.write_text("robot:right\n", encoding="utf-8")
    good = {"transport/auth/usrpwd/user": "robot", "transport/auth/usrpwd/password": "right"}
    bad = {**good, "transport/auth/usrpwd/password": "wrong"}
    endpoint = f"{LOCAL}/{issued}/router.sock"
    router = opened("router", [endpoint], [], {**good, "transport/auth/usrpwd/dictionary_file": str(words)})
    try:
        opened("client", [], [endpoint], good).close()  # type: ignore[no-untyped-call]
        for options in (bad, {}):
            with pytest.raises(zenoh.ZError):
                opened("client", [], [endpoint], {**options, "connect/timeout_ms": 500})
    finally:
        router.close()  # type: ignore[no-untyped-call]


def by_interface(name: str) -> dict[str, Any]:
    """Rules that allow everything to whoever comes by a network interface."""
    options = allowing(("-", ["ingress", "egress"], EVERYTHING, ["**"]))
    options["access_control"]["subjects"][1] = {"id": "s0", "interfaces": [name]}
    return options


@pytest.mark.parametrize(("room", "heard"), [(by_interface("lo"), 1), (by_interface("eth9"), 0)], indirect=["room"])
def test_rules_can_be_those_of_an_interface(room: Room, heard: int) -> None:
    ada = room.client("ada")
    ada.put("r/x", b"")
    if heard:
        assert room.heard_from(ada, "r/x") == 1
    else:
        assert not list(ada.liveliness().get("r/**", timeout=SECOND_S))
        assert room.heard == []


def test_peers_pass_nothing_on_so_that_all_of_a_region_must_be_connected(tmp_path: Path) -> None:
    """Peers a and c are connected with b, not with each other. An option that let peers pass messages on is gone."""
    with pytest.raises(zenoh.ZError, match="unknown key"):
        zenoh.Config().insert_json5("routing/peer/mode", json.dumps("linkstate"))
    ends = {name: f"{LOCAL}/{tmp_path}/{name}.sock" for name in "abc"}
    a = opened("peer", [ends["a"]], [], {})
    b = opened("peer", [ends["b"]], [ends["a"]], {})
    c = opened("peer", [ends["c"]], [ends["b"]], {})
    got: list[str] = []
    try:
        with (
            a.declare_subscriber("r/**", lambda sample: got.append(f"a {sample.key_expr}")),
            b.declare_subscriber("r/**", lambda sample: got.append(f"b {sample.key_expr}")),
        ):
            publisher = c.declare_publisher("r/x")
            until(lambda: publisher.matching_status.matching, "b is known")  # type: ignore[attr-defined]
            publisher.put(b"")
            until(lambda: "b r/x" in got, "b hears it")
            b.put("r/end", b"")
            until(lambda: "a r/end" in got, "a hears b")
            assert "a r/x" not in got
    finally:
        for session in (c, b, a):
            session.close()  # type: ignore[no-untyped-call]
