"""The benches one after another, and their results against those that are stored."""

from __future__ import annotations

import argparse
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from bench.ended import leave_when_ended
from bench.entries import ENTRIES
from bench.report import Result, decode, number, ratios, worse

ROOT = Path(__file__).parent.parent
STORED = ROOT / "bench" / "results"
FRESH = ROOT / "out" / "bench"


def names(chosen: Sequence[str]) -> list[str]:
    """The suite's benches, or those that were chosen."""
    return list(chosen) or [name for name, entry in ENTRIES.items() if entry.kind == "suite"]


def read(folder: Path) -> dict[str, Result]:
    """The results in a folder, by bench. Raises ValueError for a file that is none."""
    return {path.stem: decode(path.read_bytes(), str(path)) for path in sorted(folder.glob("*.json"))}


def _run(name: str, short: bool) -> Result | None:
    """Run a bench in a process of its own, and keep its result; None where it ended without one."""
    command = [sys.executable, "-m", "bench", name, "--json", *(["--short"] if short else [])]
    begun_s = time.monotonic()
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE) as process:  # not killed: it may have a robot
        printed, _ = process.communicate()
    seconds = time.monotonic() - begun_s
    try:
        result = decode(printed, f"what {name} printed")
    except ValueError as error:
        print(f"{name:<14} {seconds:4.0f} s  FAILED with exit code {process.returncode}: {error}", flush=True)
        return None
    FRESH.mkdir(parents=True, exist_ok=True)
    (FRESH / f"{name}{'-short' if short else ''}.json").write_bytes(printed)
    missed = [figure for figure in result.figures if not figure.kept]
    bounded = sum(bool(figure.bound) for figure in result.figures)
    print(f"{name:<14} {seconds:4.0f} s  {bounded - len(missed)} of {bounded} bounds kept", flush=True)
    for figure in missed:
        print(f"    missed: {figure.name}: {number(figure.median)} {figure.unit}, {figure.bound}")
    return result


def _parser(word: str, about: str) -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(f"python -m bench {word}", description=about)
    parser.add_argument("names", nargs="*", choices=[[], *ENTRIES], metavar="NAME", help="only these benches")
    return parser


def run_suite(arguments: Sequence[str]) -> int:
    """Run the suite's benches. Exit code 1 when one failed or missed a bound."""
    parser = _parser("suite", "Run the suite's benches one after another.")
    parser.add_argument("--short", action="store_true", help="the short form of each")
    chosen = parser.parse_args(arguments)
    leave_when_ended()
    begun_s = time.monotonic()
    results = [_run(name, chosen.short) for name in names(chosen.names)]
    print(f"all in {(time.monotonic() - begun_s) / 60:.1f} min; results in {FRESH.relative_to(ROOT)}")
    return 0 if all(result is not None and result.kept for result in results) else 1


def store(arguments: Sequence[str]) -> int:
    """Keep fresh results of full runs as those to compare with."""
    chosen = _parser("store", "Keep results of out/bench in bench/results.").parse_args(arguments)
    fresh = {name: result for name, result in read(FRESH).items() if result.form == "full"} if FRESH.is_dir() else {}
    wanted = chosen.names or list(fresh)
    missing = [name for name in wanted if name not in fresh]
    if missing or not wanted:
        print(f"no full result of {', '.join(missing) or 'any bench'} in {FRESH}: run `python -m bench suite` first")
        return 1
    STORED.mkdir(parents=True, exist_ok=True)
    for name in wanted:
        (STORED / f"{name}.json").write_bytes((FRESH / f"{name}.json").read_bytes())
        print(f"stored {name}")
    return 0


def fallen(now: Result, stored: Result) -> list[str]:
    """What is worse than stored: ratios that fell by more than a third, a sentence each. A ratio of the short form that
    the stored result does not have cannot be compared, and is an error of its own."""
    kept, told = ratios(stored.figures), []
    for name, figure in ratios(now.figures).items():
        if name not in kept:
            told.append(f"{now.bench}: {name}: there is no stored ratio of this name; store the full form again")
        elif worse(figure, kept[name]):
            told.append(f"{now.bench}: {name}: {number(figure.median)}, stored {number(kept[name].median)}")
    return told


def check(arguments: Sequence[str]) -> int:
    """Run the short forms, twice where a ratio fell. Exit code 1 when a bench failed or a ratio fell both times."""
    chosen = _parser("check", "Run the short forms and compare their ratios with the stored ones.").parse_args(
        arguments
    )
    leave_when_ended()
    stored, bad = read(STORED), []
    for name in names(chosen.names):
        if name not in stored:
            bad.append(f"{name}: no stored result; run `python -m bench suite {name}` and `python -m bench store`")
            continue
        for attempt in (1, 2):  # a machine that did other work for a second is no regression
            result = _run(name, short=True)
            told = [f"{name} failed"] if result is None else fallen(result, stored[name])
            if not told:
                break
            if attempt == 2:
                bad += told
    print("\n".join([f"FELL {line}" for line in bad]) or "no ratio fell by more than a third")
    return 1 if bad else 0
