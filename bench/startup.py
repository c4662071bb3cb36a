"""Processor time that the command takes to start, to print its help, and to complete a word for the shell.

`python -m bench.startup [--runs N]` prints the median over N runs. It is processor time (user and system), which load
changes little; on an idle core it is about the time that a person waits.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
from statistics import median

LINES = (
    "cocoro f", "cocoro fetch r", "cocoro up --scene p", "cocoro up --profile s", "cocoro status --robot c",
    "cocoro echo planning/s", "cocoro logs p", "cocoro capture i", "cocoro replay latest", "cocoro rehearse go-to b",
)  # fmt: skip


def processor_s(arguments: list[str], environment: dict[str, str]) -> float:
    """Processor time of one run of the command, s."""
    before = os.times()
    subprocess.run(
        [sys.executable, "-m", "apps.cli.main", *arguments],
        env=os.environ | environment, stdout=subprocess.DEVNULL, check=True,
    )  # fmt: skip
    after = os.times()
    return after.children_user - before.children_user + after.children_system - before.children_system


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=5)
    runs = parser.parse_args().runs
    cases = [("cocoro --help", ["--help"], dict[str, str]()), ("cocoro --version", ["--version"], {})]
    for line in LINES:
        environment = {"_COCORO_COMPLETE": "complete_bash", "COMP_WORDS": line, "COMP_CWORD": str(line.count(" "))}
        cases.append((f"Tab after: {line}", [], environment))
    for name, arguments, environment in cases:
        times = [processor_s(arguments, environment) for _ in range(runs)]
        print(f"{name:<36} {median(times):.2f} s ({min(times):.2f} to {max(times):.2f})")


if __name__ == "__main__":
    main()
