"""Where a rehearsal's processor time goes: `python -m bench.simulator_split REQUEST` prints it by parts as JSON.

Everything runs in one thread, the drawing too (Mesa's own threads are off), so that the thread's processor time is all
there is. A part's functions are wrapped; the time of another part's function that they call is not theirs.
"""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Callable
from functools import wraps
from typing import Any

DRAWING, READ_BACK, EFFECTS, PHYSICS, BODY, PERCEPTION, PLANNING, LOOP = PARTS = (
    "drawing",
    "read-back",
    "the sensor's errors and codes",
    "physics and motors",
    "poses, states and truth",
    "perception",
    "planning",
    "messages, executive, judge, loop",
)


class Split:
    """Processor time of this thread by parts, s. What belongs to no part's function is the loop's."""

    def __init__(self) -> None:
        self.spent_s = dict.fromkeys(PARTS, 0.0)
        self._within = [LOOP]
        self._since_s = time.thread_time()

    def turn_to(self, part: str) -> None:
        """A function of this part begins."""
        self._account()
        self._within.append(part)

    def turn_back(self) -> None:
        """The function that began last has ended."""
        self._account()
        self._within.pop()

    def _account(self) -> None:
        now_s = time.thread_time()
        self.spent_s[self._within[-1]] += now_s - self._since_s
        self._since_s = now_s

    def wrap(self, owner: Any, name: str, part: str, before: Callable[..., Any] | None = None) -> None:
        """Count a method's time as that of a part. `before` is called with the object first, and not counted so."""
        method: Callable[..., Any] = getattr(owner, name)

        @wraps(method)
        def counted(*args: Any, **options: Any) -> Any:
            if before is not None:
                before(args[0])
            self.turn_to(part)
            try:
                return method(*args, **options)
            finally:
                self.turn_back()

        setattr(owner, name, counted)


def main() -> None:
    request: dict[str, Any] = json.loads(sys.argv[1])
    os.environ.update(OPENBLAS_NUM_THREADS="1", LP_NUM_THREADS="0")
    from apps.rehearsal.rehearse import rehearse
    from apps.rehearsal.request import RehearsalRequest
    from services.perception.core import PerceptionCore
    from services.planning.core import PlanningCore
    from sim.camera import SimKinect
    from sim.render.gl import GlRenderer
    from sim.world import World

    split = Split()

    def finish(renderer: Any) -> None:
        """Finish what was only begun: drawing, and no part of the read-back."""
        split.turn_to(DRAWING)
        renderer._ctx.finish()
        split.turn_back()

    for name in ("picture", "metres"):
        split.wrap(GlRenderer, name, READ_BACK, finish)
    for owner, names, part in (
        (GlRenderer, ("place", "draw", "draw_depth"), DRAWING),
        (SimKinect, ("capture",), EFFECTS),
        (World, ("step",), PHYSICS),
        (World, ("view", "truth", "base_state", "servo_state"), BODY),
        (PerceptionCore, ("step",), PERCEPTION),
        (PlanningCore, ("step",), PLANNING),
    ):
        for name in names:
            split.wrap(owner, name, part)
    split.turn_to(LOOP)
    split.spent_s = dict.fromkeys(PARTS, 0.0)
    result = rehearse(RehearsalRequest(task={"task": "fetch", "label": "red_can"}, **request))
    split.turn_back()
    print(json.dumps({**split.spent_s, "sim_s": result["sim_s"]}))


if __name__ == "__main__":
    main()
