"""How a comparison of two hosts' clocks is said to people. `cocoro status` imports it, so it imports nothing."""

from __future__ import annotations

TYPE_CHECKING = False
"""As in `typing`, which takes 2 ms to import."""
if TYPE_CHECKING:
    from typing import Any


def said(offset: Any) -> str:
    """One host's `ClockOffset`, such as `brain 0.2 ms behind body, sure to 0.6 ms, drifts 12 ppm`; '' for the
    keeper."""
    if offset.state == "keeps":
        return ""
    if offset.ahead_s is None or offset.uncertainty_s is None:
        words = f"{offset.host} not compared with {offset.keeper} yet"
    else:
        words = f"{offset.host} {apart(offset.ahead_s, offset.keeper)}, sure to {amount(offset.uncertainty_s)}"
        if offset.gains_ppm is not None:
            words += f", drifts {offset.gains_ppm:.0f} ppm"
    return f"{words} (refused)" if offset.state == "refused" else words


def apart(ahead_s: float, keeper: str) -> str:
    return f"{amount(abs(ahead_s))} {'ahead of' if ahead_s > 0 else 'behind'} {keeper}"


def amount(seconds: float) -> str:
    """A time in its own unit: `0.2 ms`, `35 ms`, `4.1 s`."""
    if seconds >= 1.0:
        return f"{seconds:.1f} s"
    return f"{1e3 * seconds:.{0 if seconds >= 0.01 else 1}f} ms"
