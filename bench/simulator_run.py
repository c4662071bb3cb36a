"""One rehearsal, as a process: `python -m bench.simulator_run REQUEST` prints its simulated time as JSON.

It starts as `cocoro rehearse` does, without the command line.
"""

from __future__ import annotations

import json
import os
import sys
from contextlib import nullcontext
from typing import Any


def main() -> None:
    request: dict[str, Any] = json.loads(sys.argv[1])
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    from apps.rehearsal.ahead import begun_ahead

    with begun_ahead() if request["camera_process"] else nullcontext():
        from apps.rehearsal.rehearse import rehearse
        from apps.rehearsal.request import RehearsalRequest

        result = rehearse(RehearsalRequest(task={"task": "fetch", "label": "red_can"}, **request))
    print(json.dumps({"outcome": result["outcome"], "sim_s": result["sim_s"]}))


if __name__ == "__main__":
    main()
