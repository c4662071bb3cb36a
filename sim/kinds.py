"""Names of the kinds of sensors and bodies that are simulated; `sim.realism` says what they are.

They stand alone so that a request is checked without importing NumPy: a rehearsal sets NumPy's threads before.
"""

from __future__ import annotations

from typing import Literal

Sensors = Literal["ideal", "real"]
BodyKind = Literal["nominal", "worn"]
