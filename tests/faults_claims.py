"""A process that contends for claims, in rounds.

Run as `python faults_claims.py ROOT NAME SERVICES ROUNDS`. For each line on standard input it tries to claim the
services and prints whether it has them; at the next line it releases them.
"""

from __future__ import annotations

import sys
from pathlib import Path

from cocoro.errors import RefusedError
from deploy.rundir import RunDir


def main() -> None:
    root, name, services = sys.argv[1:4]
    run_dir = RunDir("robbie", Path(root))
    print("ready", flush=True)
    for _ in sys.stdin:
        try:
            claims = run_dir.claim(name, services.split(","))
            print("won", flush=True)
        except RefusedError as error:
            claims = []
            print(f"refused: {error}", flush=True)
        if not sys.stdin.readline():
            return
        for claim in claims:
            claim.release()
        print("over", flush=True)


if __name__ == "__main__":
    main()
