"""Measures the time of a planner's step: those of recorded rehearsals, executed again one after the other.

Two fetches are rehearsed and recorded; the steps of each are then given to a new planner, several times over, and each
step counts at its fastest: what other programs took is left out. The planner steps 50 times a second, so a step may
take 20 ms, and on a robot's computer less.
"""

from __future__ import annotations

import argparse
import gc
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from apps.captures.recorded import origins, steps_of, with_messages
from apps.rehearsal.rehearse import rehearse
from apps.rehearsal.request import RehearsalRequest
from bench.report import Report, percentile
from bench.trials import sized
from cocoro.capture.reader import Capture
from cocoro.core import Core, Sample
from cocoro.messages import Message
from services.executive.tasks import FetchTask

FETCHES = (("paper", 0, "red_can"), ("random", 7, "yellow_ball"))
"""Scene, seed and what is fetched: in the open, and between obstacles."""


class Input(NamedTuple):
    now_ns: int
    samples: Sequence[Sample]


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--passes", type=int, help="executions of each rehearsal's steps (10)")


def measure(chosen: argparse.Namespace, report: Report) -> None:
    passes = sized(chosen, chosen.passes, 10, 3)
    for scene, seed, label in FETCHES:
        with tempfile.TemporaryDirectory(prefix="cocoro-") as folder:
            path = Path(folder) / "fetch.mcap"
            rehearse(
                RehearsalRequest(
                    task=FetchTask(label=label),
                    scene=scene,
                    seed=seed,
                    width=160,
                    height=120,
                    frame_rate_hz=15.0,
                    record=str(path),
                )
            )
            with Capture.open(path) as capture, origins([capture], "planning") as made:
                runs = []
                for _ in range(passes):
                    core = made[0].core()
                    runs.append(_times_ms(core, _inputs(capture, core)))
        fastest = [min(times) for times in zip(*runs, strict=True)]
        report.say(f"{scene}: {len(fastest)} steps, {passes} times")
        for name, percent in (("median", 50.0), ("99%", 99.0), ("worst", 100.0)):
            report.value(f"{scene}: step, {name}", [percentile(fastest, percent)], "ms")


def _inputs(capture: Capture, core: Core) -> list[Input]:
    """The inputs of all steps of a capture; each pass decodes its own, for a core may keep them."""
    topics = {topic.name: topic for topic in core.reads}
    inputs = []
    for step in with_messages([capture], steps_of([capture], "planning")):
        samples = []
        for name in step.record.consumed:
            message = step.messages[name].capture.read(step.messages[name].record)
            assert isinstance(message, Message)
            samples.append(Sample(topics[name[0]], message))
        inputs.append(Input(step.record.now_ns, samples))
    return inputs


def _times_ms(core: Core, inputs: Sequence[Input]) -> list[float]:
    times_ms = []
    gc.collect()
    gc.freeze()
    for now_ns, samples in inputs:
        started = time.perf_counter()
        core.step(samples, now_ns)
        times_ms.append(1e3 * (time.perf_counter() - started))
    gc.unfreeze()
    return times_ms
