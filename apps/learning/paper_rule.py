"""The paper's learning of the hand-eye map, in every reading that its text allows, and in those that it contradicts.

The text lost its equations, so it leaves open what a comparison hangs on: in one pass at its rates the held-out error
is between 2 and 30 cm. A `Reading` is a choice on each of the `AXES`; each choice says which statements of the text it
agrees with, which it contradicts, and what it decides where the text is silent. A baseline has to be as strong as its
source allows, so the experiments compare with the best readings (`AS_PRINTED`, `SEARCHED`), and
`python -m bench baselines` measures all of them.

What the text is silent on, the first author's public library of such networks answers (github.com/bgalbraith/pyrbfn,
September 2014): normalised activations, steps that are not divided by their length, centres at the ends of the range,
and random weights within +-1 at the start. It is no part of the text; here the weights start at zero, because one pass
at the text's rates does not remove random ones.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from enum import Enum
from itertools import product
from typing import Any

from apps.learning.method import Method


class Statement(Enum):
    """What the text says of the network: section, and its words."""

    CENTRES = "Results: 'centers were spread evenly across the joint input space of [-2.62, 2.62] radians per joint'"
    SEARCH = (
        "Results: 'a grid search was conducted using the collected data to determine the number of bases, Gaussian"
        " width, and learning rate'"
    )
    PRIMING = "Results: '10,000 distinct evenly spaced joint configurations' were used 'to prime the network'"
    TENTH = "Discussion: primed at 'a learning rate an order of magnitude lower'"
    ONCE = "Results: 'data points were presented sequentially and only once'"
    NUMBERS = "Results: 'three bases per input dimension', 'σ = 1.57, and α = 0.025'"
    SPHERICAL = "Discussion: the network 'was based in spherical coordinates'"


@dataclass(frozen=True)
class Choice:
    """A choice on one axis."""

    name: str
    fields: dict[str, Any] = field(hash=False)
    """The fields of a `Method` that it sets."""
    agrees: tuple[Statement, ...] = ()
    contradicts: tuple[Statement, ...] = ()
    silent: str = ""
    """What it decides that the text is silent on."""


AXES: dict[str, tuple[Choice, ...]] = {
    "activation": (
        Choice("normalised", {"normalised": True}, silent="h = g / sum g, as in the first author's library"),
        Choice("plain", {"normalised": False}, silent="h = g, a radial basis function network without more"),
    ),
    "step": (
        Choice("plain steps", {"by_length": False}, silent="dw = a (t - y) h, dv = a (t - y) h c, as in that library"),
        Choice("steps by length", {"by_length": True},
               silent="both divided by |(h, h c)|^2, so that a is a share of the error"),
    ),
    "centres": (
        Choice("centres at the ends", {"centres": "at the ends"}, (Statement.CENTRES,),
               silent="-2.62, 0, 2.62, as in that library"),
        Choice("centres inside", {"centres": "inside"}, (Statement.CENTRES,),
               silent="in the middle of equal parts of the range: -1.75, 0, 1.75"),
    ),
    "width": (
        Choice("σ halved", {"width_share": 1.0}, silent="g = exp(-d^2 / (2 σ^2)), as in that library"),
        Choice("σ whole", {"width_share": 0.5**0.5}, silent="g = exp(-d^2 / σ^2): 1.57 is 1.11 of the other"),
    ),
    "coordinates": (
        Choice("spherical", {"coordinates": "spherical"}, (Statement.SPHERICAL,)),
        Choice("Cartesian", {"coordinates": "cartesian"}, contradicts=(Statement.SPHERICAL,)),
    ),
    "priming": (
        Choice("primed shuffled", {"priming": "shuffled"}, (Statement.PRIMING, Statement.TENTH),
               silent="the order of the priming points: a fixed shuffle"),
        Choice("primed in order", {"priming": "in order"}, (Statement.PRIMING, Statement.TENTH),
               silent="the order of the priming points: joint by joint, as a nested loop has it"),
        Choice("not primed", {"priming": "none"}, contradicts=(Statement.PRIMING, Statement.TENTH)),
    ),
    "passes": (
        Choice("once", {"passes": 1}, (Statement.ONCE,)),
        Choice("ten times", {"passes": 10}, contradicts=(Statement.ONCE,)),
    ),
}  # fmt: skip

NUMBERS = Choice("the text's numbers", {}, (Statement.NUMBERS,))
"""Bases, width and rate as printed. They were found by a search on the samples of another robot."""
FOUND_AGAIN = Choice(
    "numbers searched again", {}, (Statement.SEARCH,), (Statement.NUMBERS,),
    silent="the grid, and that it is scored by cross-validation over draws",
)  # fmt: skip
"""The text's procedure in place of its numbers: the search is made on the samples of the body at hand."""


@dataclass(frozen=True)
class Reading:
    """A reading: a choice on each axis, and where bases, width and rate come from."""

    choices: tuple[Choice, ...]
    numbers: Choice = NUMBERS
    bases: int = 3
    sigma: float = 1.57
    rate: float = 0.025

    @property
    def name(self) -> str:
        told = ", ".join(choice.name for choice in self.choices)
        if self.numbers is NUMBERS:
            return told
        return f"{told}; {self.bases} bases a joint, σ {self.sigma:g}, α {self.rate:g}"

    @property
    def contradicts(self) -> tuple[Statement, ...]:
        """The statements of the text that it contradicts."""
        return tuple(statement for choice in (*self.choices, self.numbers) for statement in choice.contradicts)

    @property
    def agrees(self) -> tuple[Statement, ...]:
        """The statements that it agrees with, of those that leave a choice."""
        return tuple(statement for choice in (*self.choices, self.numbers) for statement in choice.agrees)

    @property
    def method(self) -> Method:
        """The method to learn by, for `apps.learning.study`."""
        fields = {key: value for choice in self.choices for key, value in choice.fields.items()}
        share = fields.pop("width_share")
        return Method(
            f"the paper's rule: {self.name}", "in order", over_nominal=False, bases=self.bases,
            width_rad=self.sigma * share, rate=self.rate, **fields,
        )  # fmt: skip

    def with_numbers(self, bases: int, sigma: float, rate: float) -> Reading:
        """The same reading with numbers that were searched again."""
        return replace(self, numbers=FOUND_AGAIN, bases=bases, sigma=sigma, rate=rate)


def reading(*names: str) -> Reading:
    """The reading with these choices, one for each axis in order. Raises KeyError for an unknown name."""
    found = []
    for name, choices in zip(names, AXES.values(), strict=True):
        found.append({choice.name: choice for choice in choices}[name])
    return Reading(tuple(found))


READINGS: tuple[Reading, ...] = tuple(Reading(choices) for choices in product(*AXES.values()))
"""Every combination, with the text's numbers."""
ALLOWED: tuple[Reading, ...] = tuple(one for one in READINGS if not one.contradicts)
"""Those that contradict no statement of the text."""

GRID_BASES, GRID_SIGMA, GRID_RATE = (3, 4), (0.785, 1.11, 1.57), (0.025, 0.1, 0.4, 0.8)


def to_search() -> tuple[Reading, ...]:
    """The readings whose numbers are searched again: all that the text's order of things allows, in both coordinates.
    The width is among the numbers, so its axis has one choice; so has the order of priming, which matters little."""
    return tuple(
        one
        for one in READINGS
        if not {Statement.ONCE, Statement.PRIMING} & set(one.contradicts)
        and {choice.name for choice in one.choices} >= {"σ halved", "primed shuffled"}
    )


def grid(one: Reading) -> Iterator[Reading]:
    """The readings of the text's grid search."""
    for bases, sigma, rate in product(GRID_BASES, GRID_SIGMA, GRID_RATE):
        yield one.with_numbers(bases, sigma, rate)


AS_PRINTED = reading("plain", "plain steps", "centres at the ends", "σ halved", "spherical", "primed shuffled", "once")
"""The best reading that contradicts no statement of the text, by the mean error on two worn bodies."""
SEARCHED = reading(
    "normalised", "steps by length", "centres inside", "σ halved", "Cartesian", "primed shuffled", "once"
).with_numbers(4, 0.785, 0.4)
"""The best reading whose numbers are searched again on two worn bodies; it contradicts `Statement.SPHERICAL`."""
IN_THE_LIBRARY = reading(
    "normalised", "plain steps", "centres at the ends", "σ halved", "spherical", "primed shuffled", "once"
)
"""The reading that agrees with the text and with the first author's library, whose weights start at random."""
