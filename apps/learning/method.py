"""A method of learning the hand-eye map: a network, how it is set, and from what."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from cocoro.learning.handmap import Coordinates
from cocoro.learning.network import PAPER_BASES, PAPER_RATE, PAPER_WIDTH_RAD


@dataclass(frozen=True)
class Method:
    """One method of learning."""

    name: str
    rule: Literal["in order", "least squares", "rigid"] = "least squares"
    """The paper's gradient rule, least squares, or the nominal model with a fitted geometry."""
    over_nominal: bool = True
    """The network learns what the nominal model leaves unexplained; else the whole map, primed by the nominal model."""
    coordinates: Coordinates = "cartesian"
    bases: int = PAPER_BASES
    """Bases per joint."""
    width_rad: float = PAPER_WIDTH_RAD
    centres: Literal["at the ends", "inside"] = "at the ends"
    """Bases from one end of a joint's range to the other, or in the middle of equal parts of it."""
    normalised: bool = True
    """The activations of all bases add up to one."""
    doubt: float = 100.0
    """For "least squares": prior variance of the weights in units of a sighting's variance."""
    rate: float = PAPER_RATE
    """For "in order", like all that follow: a in the paper's rule."""
    by_length: bool = False
    """A step is divided by the features' squared length."""
    priming: Literal["shuffled", "in order", "none"] = "shuffled"
    passes: int = 1
    """How often each sighting is learned."""
