"""Reachability: incremental as batch, honest at hollows, sensible with little."""

from __future__ import annotations

import numpy as np
import pytest

from cocoro.arrays import FloatArray
from services.planning.reachability import ReachMesh, ReachVerdict


def shell(count: int, seed: int = 0, inner_m: float = 0.25, outer_m: float = 0.5) -> FloatArray:
    """Places evenly within a thick shell about the origin: a workspace with a hollow in the middle."""
    rng = np.random.default_rng(seed)
    directions = rng.normal(size=(count, 3))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    radii = rng.uniform(inner_m**3, outer_m**3, count) ** (1 / 3)
    return np.asarray(directions * radii[:, None])


def test_amidst_what_was_seen_is_inside_and_beyond_it_outside() -> None:
    mesh = ReachMesh(shell(3000))
    assert mesh.verdict((0.38, 0.0, 0.0)) is ReachVerdict.INSIDE
    assert mesh.verdict((0.0, -0.27, -0.27)) is ReachVerdict.INSIDE
    assert mesh.verdict((0.6, 0.0, 0.0)) is ReachVerdict.OUTSIDE


def test_a_hollow_is_not_called_reachable_though_the_hull_holds_it() -> None:
    mesh = ReachMesh(shell(3000))
    inside_hollow = shell(200, seed=3, inner_m=0.0, outer_m=0.18)
    assert set(mesh.verdicts(inside_hollow).tolist()) == {ReachVerdict.UNPROVEN}


def test_a_dent_from_outside_is_not_called_reachable_either() -> None:
    places = np.random.default_rng(0).uniform(-0.4, 0.4, (6000, 3))
    dented = places[(np.abs(places[:, :2]).max(axis=1) > 0.15) | (places[:, 2] < 0.0)]
    mesh = ReachMesh(dented)
    assert mesh.verdict((0.0, 0.0, 0.25)) is ReachVerdict.UNPROVEN
    assert mesh.verdict((0.0, 0.0, -0.2)) is ReachVerdict.INSIDE
    assert mesh.verdict((0.3, 0.0, 0.25)) is ReachVerdict.INSIDE


def test_the_volume_is_that_of_the_shell_and_not_of_its_hull() -> None:
    mesh = ReachMesh(shell(6000))
    true = 4 / 3 * np.pi * (0.5**3 - 0.25**3)
    assert mesh.volume_m3() == pytest.approx(true, rel=0.12)


@pytest.mark.parametrize("lump", [1, 7, 500])
def test_place_by_place_the_mesh_is_that_of_all_at_once(lump: int) -> None:
    places = shell(900)
    grown = ReachMesh(radius_m=0.06)
    for start in range(0, len(places), lump):
        grown.add(places[start : start + lump])
    batch = ReachMesh(places, radius_m=0.06)
    asked = np.random.default_rng(1).uniform(-0.6, 0.6, (2000, 3))
    assert np.array_equal(grown.verdicts(asked), batch.verdicts(asked))
    assert grown.volume_m3() == pytest.approx(batch.volume_m3())


def test_one_by_one_the_answers_are_those_of_the_batch() -> None:
    mesh = ReachMesh(shell(500))
    asked = np.random.default_rng(2).uniform(-0.6, 0.6, (50, 3))
    assert [mesh.verdict(place) for place in asked] == mesh.verdicts(asked).tolist()


@pytest.mark.parametrize(
    "places",
    [
        np.empty((0, 3)),
        np.zeros((1, 3)),
        np.eye(3),
        np.c_[np.random.default_rng(0).uniform(size=(30, 2)), np.zeros(30)],
    ],
    ids=["none", "one", "three", "a plane"],
)
def test_too_little_proves_nothing(places: FloatArray) -> None:
    mesh = ReachMesh(places)
    assert mesh.verdict((0.3, 0.3, 0.0)) is ReachVerdict.OUTSIDE
    assert mesh.volume_m3() == 0.0


def test_a_plane_becomes_a_body_once_something_is_seen_beside_it() -> None:
    rng = np.random.default_rng(0)
    flat = np.c_[rng.uniform(-0.1, 0.1, (100, 2)), np.zeros(100)]
    mesh = ReachMesh(flat)
    mesh.add(rng.uniform(-0.1, 0.1, (300, 3)))
    assert mesh.verdict((0.0, 0.0, 0.03)) is ReachVerdict.INSIDE


def test_doubles_add_nothing() -> None:
    places = shell(400)
    mesh = ReachMesh(places)
    held = len(mesh.places_m)
    mesh.add(places)
    mesh.verdict((0.0, 0.0, 0.0))
    assert len(mesh.places_m) == held
