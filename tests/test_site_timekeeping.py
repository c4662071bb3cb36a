"""A host's time by its gateway, in virtual time: two clocks, a network between them, and what becomes of the offset."""

from __future__ import annotations

import asyncio
import random
from typing import Any

import pytest
from node_rig import Mesh

from cocoro.clock import NS, steady_ns
from cocoro.errors import CocoroError
from cocoro.messages import ClockOffset, TimeReply, TimeRequest
from cocoro.testing.virtual import in_virtual_time
from cocoro.topics import EXCHANGES, OFFSET, TIME
from deploy.robot_time import ALONE, COMPARED, OWN, SETTABLE, Setting
from deploy.site import asking
from deploy.site.clock_words import said
from deploy.site.offset_estimate import PPM, SLEW_PPM
from deploy.site.timekeeping import BACK_NS, PATIENCE_S, Timekeeping, tell_time

MS = NS // 1000
KEEPER, OTHER = "body", "brain"
BODY_NS, BRAIN_NS = 5_000 * NS, 900_000 * NS
"""The steady clocks at the beginning."""
WALL_NS = 1_900_000_000 * NS
"""The keeper's offset."""


def loop_ns() -> float:
    return asyncio.get_running_loop().time() * NS


class Hosts:
    """The keeper answers over a network of 1 ms and jitter each way; `brain` compares itself with it."""

    def __init__(
        self, *, off_s: float = 0.0, ppm: float = 0.0, jitter_s: float = 0.001, origin: int = SETTABLE, **more: Any
    ) -> None:
        """`off_s`: by how much the wall clock of `brain` is ahead; `ppm`: by how much its steady clock is too fast."""
        self.mesh = Mesh()
        self.ppm, self.jitter_s, self.there = ppm, jitter_s, True
        self.random = random.Random(1)
        self.cells = [WALL_NS + BODY_NS - BRAIN_NS + round(off_s * NS), origin]
        self.keeper_ns = WALL_NS
        self.stores = [self.cells[0]]
        self.options = more

    def brain_steady(self) -> int:
        return BRAIN_NS + round(loop_ns() * (1 + self.ppm * PPM))

    def body_time(self) -> int:
        return self.keeper_ns + BODY_NS + round(loop_ns())

    @property
    def apart_ns(self) -> int:
        """The truth: brain's time minus the keeper's."""
        return self.cells[0] + self.brain_steady() - self.body_time()

    def refused(self) -> bool:
        return self.keeping.refused

    async def __aenter__(self) -> Hosts:
        self.body = self.mesh.node(f"gateway-{KEEPER}")
        self.brain = self.mesh.node(f"gateway-{OTHER}")
        await self.body.__aenter__()
        await self.brain.__aenter__()
        self.body.serve(TIME.of(self.body.name), self._answer)
        setting = _Watched(self)
        limit_s = self.options.pop("limit_s", 0.025)
        self.keeping = Timekeeping(self.brain, OTHER, setting, steady=self.brain_steady, **self.options)
        self.keeping.follow(KEEPER, limit_s)
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.brain.__aexit__()
        await self.body.__aexit__()

    async def _answer(self, _: TimeRequest) -> TimeReply:
        if not self.there:
            await asyncio.sleep(2 * asking.ANSWER_S)
            raise CocoroError("too late for anybody")
        await asyncio.sleep(0.001 + self.random.expovariate(1 / self.jitter_s))
        received_ns = self.body_time()
        reply = TimeReply(received_ns=received_ns, answered_ns=received_ns)
        await asyncio.sleep(0.001 + self.random.expovariate(1 / self.jitter_s))
        return reply


class _Watched(Setting):
    def __init__(self, hosts: Hosts) -> None:
        super().__init__(hosts.cells)
        self._stores = hosts.stores

    def correct(self, offset_ns: int) -> None:
        super().correct(offset_ns)
        self._stores.append(offset_ns)


@pytest.mark.parametrize("off_s", [-7_200.0, -0.3, 0.0, 0.004, 7_200.0])
@in_virtual_time
async def test_a_host_s_time_is_set_at_once_before_its_processes_start(off_s: float) -> None:
    async with Hosts(off_s=off_s, ppm=30.0) as hosts:
        await hosts.keeping.begin()
        assert abs(hosts.apart_ns) < MS
        assert hosts.cells[1] == COMPARED
        assert len(hosts.stores) == 2, "one store"
        assert not hosts.refused()
        assert loop_ns() < NS


@pytest.mark.parametrize("ppm", [-80.0, 30.0])
@in_virtual_time
async def test_the_drift_is_made_up_for_without_a_step(ppm: float) -> None:
    async with Hosts(off_s=0.3, ppm=ppm) as hosts:
        await hosts.keeping.begin()
        hosts.brain.spawn(hosts.keeping.run())
        began = len(hosts.stores)
        for _ in range(30):
            await asyncio.sleep(10.0)
            assert abs(hosts.apart_ns) < 2 * MS
        steps = [later - one for one, later in zip(hosts.stores[began - 1 :], hosts.stores[began:], strict=False)]
        assert min(steps) >= -BACK_NS
        assert max(steps) <= SLEW_PPM * PPM * 1.1 * NS
        now = hosts.keeping.offset()
        assert now.gains_ppm == pytest.approx(ppm, abs=5.0)
        assert now.uncertainty_s is not None
        assert abs(hosts.apart_ns / NS - (now.ahead_s or 0.0)) < now.uncertainty_s


@pytest.mark.parametrize("off_s", [-0.01, 0.01])
@in_virtual_time
async def test_while_processes_run_a_difference_is_slewed_away(off_s: float) -> None:
    async with Hosts(off_s=off_s, origin=COMPARED) as hosts:
        await hosts.keeping.begin()
        hosts.brain.spawn(hosts.keeping.run())
        await asyncio.sleep(10.0)
        assert abs(hosts.apart_ns) > 4 * MS, "at most 0.5 ms a second"
        await asyncio.sleep(60.0)
        assert abs(hosts.apart_ns) < MS
        assert not hosts.refused()


@in_virtual_time
async def test_a_clock_that_is_too_far_off_is_refused_until_it_has_been_slewed_near() -> None:
    async with Hosts(off_s=0.05, origin=COMPARED) as hosts:
        await hosts.keeping.begin()
        hosts.brain.spawn(hosts.keeping.run())
        await asyncio.sleep(2.0)
        assert hosts.refused()
        assert hosts.keeping.trouble.startswith("its clock is 49 ms ahead of body, sure to ")
        assert "started anew" in hosts.keeping.trouble
        await asyncio.sleep(50.0)
        assert hosts.refused(), "24 ms are not near enough"
        await asyncio.sleep(70.0)
        assert not hosts.refused()
        assert hosts.keeping.trouble == ""


@in_virtual_time
async def test_a_network_that_leaves_too_much_doubt_is_refused() -> None:
    async with Hosts(limit_s=0.0008) as hosts:
        await hosts.keeping.begin()
        hosts.brain.spawn(hosts.keeping.run())
        await asyncio.sleep(5.0)
        assert hosts.refused()
        assert abs(hosts.apart_ns) < MS


@in_virtual_time
async def test_the_start_waits_for_the_keeper_for_a_while_only_and_then_is_refused() -> None:
    async with Hosts(off_s=0.002) as hosts:
        hosts.there = False
        await hosts.keeping.begin()
        assert PATIENCE_S * NS <= loop_ns() < (PATIENCE_S + 2) * NS
        assert hosts.cells[1] == ALONE
        assert hosts.stores == hosts.cells[:1], "nothing was set"
        assert hosts.keeping.trouble == (
            "its clock is not compared: body does not answer; what brain says is not passed on"
        )
        hosts.there = True
        hosts.brain.spawn(hosts.keeping.run())
        await asyncio.sleep(20.0)
        assert not hosts.refused()
        assert abs(hosts.apart_ns) < MS, "slewed, not set"


@in_virtual_time
async def test_without_answers_a_host_is_refused_once_its_clock_may_have_drifted_too_far() -> None:
    async with Hosts() as hosts:
        await hosts.keeping.begin()
        hosts.brain.spawn(hosts.keeping.run())
        await asyncio.sleep(60.0)
        hosts.there = False
        await asyncio.sleep(600.0)
        assert not hosts.refused()
        await asyncio.sleep(1800.0)
        assert hosts.refused()
        hosts.there = True
        await asyncio.sleep(10.0)
        assert not hosts.refused()


@in_virtual_time
async def test_the_simulator_s_time_is_not_corrected_and_hosts_are_compared_all_the_same() -> None:
    async with Hosts(off_s=3.0, origin=OWN, corrects=False) as hosts:
        await hosts.keeping.begin()
        hosts.brain.spawn(hosts.keeping.run())
        await asyncio.sleep(30.0)
        assert len(hosts.stores) == 1
        assert not hosts.refused()
        now = hosts.keeping.offset()
        assert now.state == "shown"
        assert now.ahead_s == pytest.approx(3.0, abs=0.002)


@in_virtual_time
async def test_the_keeper_is_compared_with_nobody() -> None:
    async with Hosts() as hosts:
        hosts.keeping.follow(OTHER, 0.025)
        await hosts.keeping.begin()
        hosts.brain.spawn(hosts.keeping.run())
        await asyncio.sleep(30.0)
        assert hosts.cells[1] == OWN
        assert hosts.keeping.offset().state == "keeps"
        assert not hosts.refused()


@in_virtual_time
async def test_the_comparison_is_published_and_its_requests_are_not() -> None:
    mesh = Mesh()
    heard: list[ClockOffset] = []
    tap = mesh.tap()
    async with mesh.node("gateway-body") as body, mesh.node("reader") as reader:
        tell_time(body, lambda: WALL_NS + round(loop_ns()))
        reader.on(OFFSET.of("*"), heard.append)
        keeping = Timekeeping(body, KEEPER, Setting([0, OWN]), steady=lambda: round(loop_ns()))
        body.spawn(keeping.run())
        clock = await asking.time_of(reader, KEEPER)
        assert clock is not None
        assert abs(clock.offset_ns - (WALL_NS + round(loop_ns()) - steady_ns())) < 10 * NS
        await asyncio.sleep(3.5)
        assert [one.state for one in heard] == ["keeps"] * 4
        assert await asking.time_of(reader, "nobody") is None
    assert tap.messages(EXCHANGES.of("gateway-body")) == []


def offset(**fields: Any) -> ClockOffset:
    return ClockOffset(**{"host": OTHER, "keeper": KEEPER, "state": "follows"} | fields)


def test_how_a_comparison_is_said() -> None:
    known = offset(ahead_s=-0.0002, uncertainty_s=0.0006, gains_ppm=12.3)
    assert said(known) == "brain 0.2 ms behind body, sure to 0.6 ms, drifts 12 ppm"
    assert said(offset(state="waits")) == "brain not compared with body yet"
    assert said(offset(state="keeps", host=KEEPER)) == ""
    far = offset(state="refused", ahead_s=4.13, uncertainty_s=0.021)
    assert said(far) == "brain 4.1 s ahead of body, sure to 21 ms (refused)"
