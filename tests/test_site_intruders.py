"""Nobody does over a site's links what he may not, whatever he tries, and the robot goes on meanwhile.

A raw client at the desk (bench/intruder.py) tries, with a certificate of its own or a stolen one; members of the
private meshes of the robot's host and of the brain's see what arrives.
"""

from __future__ import annotations

import os
import socket
import ssl
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import pytest
from intruder_rig import GHOST, LOGGED, MARK, PRINCIPALS, Attempt, allowed, attempts
from places import in_short_folder

from bench.intruder import RANDOM, Intruder
from bench.site_lab import BRAIN, PORT, ROBOT, Lab, lab
from bench.site_witness import Witness, until
from cocoro.messages import BaseCommand, BaseState, Health, TopicHealth
from cocoro.topics import BASE_COMMAND, BASE_STATE, HEALTH, REPORT, TRUTH
from deploy.site import authority, place
from deploy.site.gateway import TOO_MUCH
from sim.network.network import obstacle

pytestmark = [pytest.mark.process, pytest.mark.zenoh]

COMMAND = BASE_COMMAND.key(ROBOT)
PERSONS = ("ada", "eve", "bob")
"""Each may ask for a report."""
CONTROLS = {"eve": None, "ada": None, "bob": f"{ROBOT}/bob/anything", BRAIN: f"{ROBOT}/perception/detections"}
"""A key on which each may publish, if any."""
HALF_OPEN = 1000
SMALL_BYTES, SMALL_HZ, SMALL_COUNT = 50, 10_000.0, 20_000
HUGE_BYTES = 100_000_000


class Scene(NamedTuple):
    """The site, with those who see what arrives."""

    lab: Lab
    body: Witness
    brain: Witness
    folder: Path

    @property
    def endpoint(self) -> str:
        return f"tls/{self.lab.body.address}:{PORT}"

    def credentials(self, who: str) -> Path:
        """Those of a principal, at the desk."""
        return self.lab.site_of(self.lab.desk) / place.CREDENTIALS / who

    def intruder(self, who: str) -> Intruder:
        found = Intruder(self.lab.desk, self.credentials(who), self.endpoint)
        assert not found.refused
        return found

    @property
    def log(self) -> str:
        return self.lab.log(self.lab.body, "gateway-body")

    def logged(self, line: str, since: int = 0) -> None:
        """Waits for a line of the gateway of the robot's host."""
        until(lambda: line in self.log[since:])

    def commanded(self) -> None:
        """Waits until the robot has got more of the planner's commands."""
        before = self.body.count.get(COMMAND, 0)
        until(lambda: self.body.count.get(COMMAND, 0) >= before + 20)

    def base(self) -> TopicHealth:
        """What the base says of the commands that it gets."""
        health = msgspec.msgpack.decode(self.body.newest[HEALTH.of("base").key(ROBOT)], type=Health)
        return next(topic for topic in health.topics if topic.key == COMMAND)

    def place(self) -> tuple[float, float]:
        state = msgspec.msgpack.decode(self.body.newest[BASE_STATE.key(ROBOT)], type=BaseState)
        return state.odometry_m


@pytest.fixture(scope="module")
def scene() -> Iterator[Scene]:
    if why := obstacle():
        pytest.skip(why)
    small: dict[str, Any] = {"width": 160, "height": 120, "frame_rate_hz": 5.0, "sensors": "ideal"}
    with in_short_folder() as folder, lab(folder, processes=("sim",), **small) as site, ExitStack() as stack:
        site.up()
        site.deliver(site.desk, (BRAIN,))  # stolen
        body, brain = (
            stack.enter_context(Witness(ROBOT, host.folder / "run", MARK.encode())) for host in (site.body, site.brain)
        )
        found = Scene(site, body, brain, folder)
        until(lambda: HEALTH.of("base").key(ROBOT) in body.newest and BASE_STATE.key(ROBOT) in body.newest)
        found.commanded()
        yield found


@pytest.fixture(scope="module")
def tried(scene: Scene) -> dict[str, list[str]]:
    """Everything has been tried once. What each principal heard in spite of the rules: the keys."""
    return {who: _try_all(scene, who) for who in PRINCIPALS}


def _try_all(scene: Scene, who: str) -> list[str]:
    mine = [one for one in attempts() if one.who == who]
    with scene.intruder(who) as intruder:
        for one in mine:
            for key in one.keys:
                match one.do:
                    case "put":
                        intruder("put", key=key, payload=one.mark)
                    case "serve":
                        intruder("serve", key=key, payload=one.mark)
                    case "show" | "hear":
                        intruder(one.do, key=key)
        for one in mine:
            if one.do == "serve":
                for key in one.keys:
                    answers = [reply.payload for reply in scene.body.ask(key, b"whose answer comes?")]
                    scene.body.marked += [(key, answer) for answer in answers if MARK.encode() in answer]
        intruder("end")  # lest it answers its own questions
        served = [(witness, witness.answer_all()) for witness in (scene.body, scene.brain)]
        if who in PERSONS:
            _ask_until_seen(scene, intruder, f"{MARK}{who}-first")  # before that, what is asked proves nothing
        for one in mine:
            if one.do == "ask":
                for key in one.keys:
                    scene.body.marked += [(key, one.mark.encode()) for _ in intruder("ask", key=key, payload=one.mark)]
        if who in PERSONS:
            _ask_until_seen(scene, intruder, f"{MARK}{who}-last")
        for witness, handle in served:
            witness.end(handle)
        if (control := CONTROLS[who]) is not None:  # one link keeps the order
            intruder("put", key=control, payload=f"{MARK}{who}-control")
            until(lambda: any(f"{who}-control".encode() in content for _, content in scene.body.marked))
        until(lambda: all(_line(one, key) in scene.log for one in mine for key in one.keys))
        return [key for key, _ in intruder("heard")]


def _ask_until_seen(scene: Scene, intruder: Intruder, mark: str) -> None:
    """Asks what everyone may ask until the brain hears it: the mesh learns a moment later that somebody answers."""

    def seen() -> bool:
        intruder("ask", key=REPORT.key(ROBOT), payload=mark)
        return mark.encode() in scene.brain.asked

    until(seen)


def _line(one: Attempt, key: str) -> str:
    return f"refused: {one.who}.1: {LOGGED[one.do]} on {key}\n"


@pytest.mark.parametrize("one", attempts(), ids=str)
def test_what_nobody_may_does_not_arrive_and_is_logged(one: Attempt, scene: Scene, tried: dict[str, list[str]]) -> None:
    for witness in (scene.body, scene.brain):
        assert not [found for found in witness.marked if one.mark.encode() in found[1]]
        assert not [found for found in witness.asked if one.mark.encode() in found]
        assert not witness.tokens & {key for key in one.keys if f"/{GHOST}/" in key and one.do == "show"}
    if one.do == "hear":
        assert not {*tried[one.who]} & {*one.keys}
    for key in one.keys:
        assert _line(one, key) in scene.log


def test_there_are_attempts_of_each_kind_for_each_topic_and_request() -> None:
    kinds = {(one.who, one.do) for one in attempts()}
    assert kinds >= {(who, do) for who in PRINCIPALS for do in ("put", "serve", "show")}
    assert kinds >= {("eve", "ask"), ("bob", "ask"), (BRAIN, "ask"), (BRAIN, "hear")}, "an operator may ask everything"
    assert len(attempts()) >= 60
    assert {one.row for one in attempts() if (one.who, one.do) == (BRAIN, "hear")} >= {TRUTH.name, BASE_COMMAND.name}


def test_what_may_be_done_is_seen(scene: Scene, tried: dict[str, list[str]]) -> None:
    """Otherwise the witnesses would prove nothing."""
    for who in ("bob", BRAIN):
        assert any(f"{MARK}{who}-control".encode() in content for _, content in scene.body.marked)
    for who in PERSONS:
        assert {f"{MARK}{who}-first".encode(), f"{MARK}{who}-last".encode()} <= {*scene.brain.asked}
    with scene.intruder("bob") as bob:
        bob("serve", key=f"{ROBOT}/bob/question", payload=f"{MARK}bob-answer")
        bob("show", key=f"{ROBOT}/bob/alive")
        until(lambda: f"{ROBOT}/bob/alive" in scene.brain.tokens and f"{ROBOT}/bob/alive" in scene.body.tokens)
        until(lambda: [reply.payload for reply in scene.body.ask(f"{ROBOT}/bob/question", b"")])


def test_refusals_are_faults_of_the_gateways_health(scene: Scene, tried: dict[str, list[str]]) -> None:
    def faults() -> bool:
        newest = scene.body.newest[HEALTH.of("gateway-body").key(ROBOT)]
        return any(fault.startswith("refused ") for fault in msgspec.msgpack.decode(newest, type=Health).faults)

    until(faults)


def test_who_has_a_hosts_certificate_at_another_place_is_shown(scene: Scene) -> None:
    with scene.intruder(BRAIN):
        places = sorted((scene.lab.brain.address, scene.lab.desk.address))
        scene.logged(f"brain is linked from {' and '.join(places)}: is its certificate stolen?")


# --- who is not let in --------------------------------------------------------------------------------


def no_certificate(scene: Scene) -> Path | None:
    return None


def foreign(scene: Scene) -> Path:
    """A certificate that says brain.1, of another authority."""
    folder = scene.folder / "foreign"
    if not folder.exists():
        folder.mkdir(mode=0o700)
        authority.init(folder, datetime.now(UTC))
        authority.issue(folder, "brain", BRAIN, datetime.now(UTC))
    return folder / place.CREDENTIALS / BRAIN


def expired(scene: Scene) -> Path:
    now = datetime.now(UTC) - timedelta(days=30)
    return authority.issue(scene.lab.plan, "operator", "former", now, days=1).folder


@pytest.mark.parametrize(
    ("whose", "why"),
    [
        (no_certificate, "peer sent no certificates"),
        (foreign, "invalid peer certificate"),
        (expired, "invalid peer certificate: certificate expired"),
    ],
    ids=lambda value: getattr(value, "__name__", ""),
)
def test_who_has_no_good_certificate_is_not_let_in(
    whose: Callable[[Scene], Path | None], why: str, scene: Scene
) -> None:
    since = len(scene.log)
    trusted = scene.credentials("eve") / place.CA_CERT
    with Intruder(scene.lab.desk, whose(scene), scene.endpoint, trusted, more={"connect/timeout_ms": 3000}) as intruder:
        assert intruder.refused
        until(lambda: why in scene.log[since:] or f"more: somebody who was not let in: {why}" in scene.log[since:])


def test_who_speaks_plain_tcp_to_the_port_is_not_let_in(scene: Scene) -> None:
    since = len(scene.log)
    plain = scene.endpoint.replace("tls/", "tcp/")
    with Intruder(scene.lab.desk, None, plain, more={"connect/timeout_ms": 3000}) as intruder:
        assert intruder.refused
    until(lambda: "not let in: received corrupt message" in scene.log[since:])


def test_random_bytes_at_the_port_harm_nobody(scene: Scene) -> None:
    for _ in range(20):
        with closing(scene.lab.desk.socket()) as odd:
            odd.connect((scene.lab.body.address, PORT))
            odd.sendall(os.urandom(500))
    with scene.intruder("ada") as ada:
        assert ada("ask", key=REPORT.key(ROBOT), payload="who answers?")
    scene.commanded()


def test_a_generation_that_is_not_admitted_may_do_nothing(scene: Scene) -> None:
    """It has a link, since its certificate is good."""
    for _ in range(3):
        newest = authority.renew(scene.lab.plan, "bob", datetime.now(UTC))
    assert newest.certificate.common_name == "bob.4"
    with Intruder(scene.lab.desk, newest.folder, scene.endpoint) as bob:
        bob("put", key=f"{ROBOT}/bob/anything", payload=f"{MARK}bob.4")
        assert not bob("ask", key=REPORT.key(ROBOT), payload="who answers?")
        scene.logged(f"bob.4 is linked from {scene.lab.desk.address}, not admitted, and may do nothing")
    assert not [found for found in scene.body.marked if b"bob.4" in found[1]]


# --- who has the brain's certificate ------------------------------------------------------------------


def test_replayed_commands_are_not_obeyed(scene: Scene) -> None:
    recorded: list[bytes] = []
    handle = scene.body.listen(COMMAND, lambda batch: recorded.extend(bytes(each.payload) for each in batch))
    until(lambda: len(recorded) >= 50)
    scene.body.end(handle)
    with scene.intruder(BRAIN) as thief:
        before = scene.base().rejected

        def rejected() -> bool:
            for payload in recorded[:50]:
                thief("put", key=COMMAND, payload=f"0x{payload.hex()}")
            return scene.base().rejected >= before + 50  # some come too soon after others, and are dropped before

        until(rejected)
    scene.commanded()


def test_a_second_planner_is_not_obeyed_beside_the_first(scene: Scene) -> None:
    where = scene.place()
    true = msgspec.msgpack.decode(scene.body.newest[COMMAND], type=BaseCommand)
    with scene.intruder(BRAIN) as thief:

        def refused() -> bool:
            newest = msgspec.msgpack.decode(scene.body.newest[COMMAND], type=BaseCommand)
            forged = msgspec.structs.replace(newest, ahead_mps=0.2, turn_radps=0.0, incarnation=true.incarnation ^ 1)
            thief("put", key=COMMAND, payload=f"0x{msgspec.msgpack.encode(forged).hex()}")
            error = scene.base().last_error
            return error == f"publisher {forged.incarnation:x} commands while {true.incarnation:x} does"

        until(refused)
    assert scene.place() == pytest.approx(where, abs=0.01)
    scene.commanded()


def test_a_forged_number_leads_nowhere(scene: Scene) -> None:
    """The incarnation is known to who hears the commands; the brain's certificate alone does not let him."""
    far = msgspec.msgpack.decode(scene.body.newest[COMMAND], type=BaseCommand).seq + 1_000_000
    with scene.intruder(BRAIN) as thief:

        def refused() -> bool:
            true = msgspec.msgpack.decode(scene.body.newest[COMMAND], type=BaseCommand)
            if true.seq == far:  # that was the forged one, which came here, too
                return False
            forged = msgspec.structs.replace(true, ahead_mps=0.2, turn_radps=0.0, seq=far)
            thief("put", key=COMMAND, payload=f"0x{msgspec.msgpack.encode(forged).hex()}")
            return str(far) in scene.base().last_error

        until(refused)
    scene.commanded()


def test_random_bytes_on_every_key_of_the_brain_harm_nobody(scene: Scene) -> None:
    where = scene.place()
    with scene.intruder(BRAIN) as thief:
        for key in allowed(BRAIN):
            for _ in range(10):
                thief("put", key=key, payload=RANDOM)
    scene.commanded()
    assert scene.place() == pytest.approx(where, abs=0.01)


# --- floods -------------------------------------------------------------------------------------------


@contextmanager
def unharmed(scene: Scene) -> Iterator[None]:
    """The robot stands, its commands go on coming, and the brain's link holds."""
    where, since = scene.place(), len(scene.log)
    yield
    scene.commanded()
    assert scene.place() == pytest.approx(where, abs=0.01)
    assert f"lost the link with brain.1 at tls/{scene.lab.brain.address}" not in scene.log[since:]


def keys_of(who: str) -> tuple[list[str], list[str]]:
    """The keys on which a principal may publish, and those on which it may not."""
    mine = [*allowed(who), *([f"{ROBOT}/bob/anything"] if who == "bob" else [])]
    return mine, [key for one in attempts() if (one.who, one.do) == (who, "put") for key in one.keys]


@pytest.mark.parametrize("who", PRINCIPALS)
def test_ten_thousand_small_messages_a_second_harm_nobody(who: str, scene: Scene) -> None:
    mine, others = keys_of(who)
    payload = f"{MARK}{who}-flood."
    with unharmed(scene), scene.intruder(who) as intruder:
        for keys, mark in ((others, payload), (mine, "")):
            if keys:
                intruder("flood", keys=keys, bytes=SMALL_BYTES, count=SMALL_COUNT, hz=SMALL_HZ, payload=mark)
        intruder("asks", key=REPORT.key(ROBOT), payload="", count=2000)
    assert not [found for found in scene.body.marked if payload.encode() in found[1]]


@pytest.mark.parametrize("who", PRINCIPALS)
def test_a_payload_of_a_hundred_megabytes_harms_nobody(who: str, scene: Scene) -> None:
    mine, others = keys_of(who)
    payload = f"{MARK}{who}-huge."
    since = len(scene.log)
    with unharmed(scene), scene.intruder(who) as intruder:
        for key in (others[0], *mine[:1]):
            intruder("flood", keys=[key], bytes=HUGE_BYTES, count=1, payload=payload)
        if who in PERSONS:
            scene.logged(f"refused: {who}.1: {TOO_MUCH}", since)
        if (control := CONTROLS[who]) is not None:  # zenoh gives up a link that takes no more for 5 s, and links anew

            def after() -> bool:
                intruder("put", key=control, payload=f"{MARK}{who}-after")
                return any(f"{who}-after".encode() in content for _, content in scene.body.marked)

            until(after)
    assert not [found for found in scene.body.marked if payload.encode() in found[1]]


# --- last, since they change the site, or keep newcomers out for a while ------------------------------


def test_who_is_revoked_may_do_nothing_from_then_on(scene: Scene) -> None:
    with scene.intruder("eve") as eve:
        assert eve("ask", key=REPORT.key(ROBOT), payload="who answers?")
        since = len(scene.log)
        authority.revoke(scene.lab.plan, "eve")
        scene.lab.deliver(scene.lab.body, ())
        scene.logged("the router is opened anew", since)
        until(lambda: "linked with eve.1" in scene.log[since:])
        assert not eve("ask", key=REPORT.key(ROBOT), payload="who answers?")
        scene.logged(f"eve.1 is linked from {scene.lab.desk.address}, not admitted, and may do nothing", since)
    until(lambda: "linked with brain.1" in scene.log[since:])
    scene.commanded()


def test_a_thousand_connections_left_half_open_cut_nobody_off(scene: Scene) -> None:
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
    with unharmed(scene), scene.intruder("ada") as ada, ExitStack() as stack:

        def connect() -> list[socket.socket]:
            target = (scene.lab.body.address, PORT)
            return [socket.create_connection(target) for _ in range(HALF_OPEN)]

        for number, held in enumerate(scene.lab.desk.call(connect)):
            stack.enter_context(closing(held))
            if number % 2:
                held.sendall(_hello(context))
        assert ada("ask", key=REPORT.key(ROBOT), payload="who answers?")


def _hello(context: ssl.SSLContext) -> bytes:
    """The first message of a handshake."""
    coming, going = ssl.MemoryBIO(), ssl.MemoryBIO()
    with pytest.raises(ssl.SSLWantReadError):
        context.wrap_bio(coming, going).do_handshake()
    return going.read()
