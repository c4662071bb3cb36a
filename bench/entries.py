"""The benches by name. `make bench` runs those of the suite; a trial has options of its own and may take hours."""

from __future__ import annotations

import ast
import importlib
from argparse import ArgumentParser, Namespace
from pathlib import Path
from typing import Literal, NamedTuple, Protocol, cast

from bench.report import Report


class Bench(Protocol):
    """The module of an entry; see `bench/report.py`."""

    def measure(self, chosen: Namespace, report: Report) -> None: ...


class Entry(NamedTuple):
    """A bench: the module that has it, and who runs it."""

    module: str
    kind: Literal["suite", "trial"] = "trial"

    @property
    def about(self) -> str:
        """The first line of the module's docstring, read without importing it."""
        source = Path(__file__).parent.joinpath(f"{self.module}.py").read_text()
        return (ast.get_docstring(ast.parse(source)) or "").partition("\n")[0]

    def load(self) -> Bench:
        """Import the module."""
        return cast(Bench, importlib.import_module(f"bench.{self.module}"))

    def options(self, parser: ArgumentParser) -> None:
        """Add the module's own options, if it has some."""
        add = getattr(self.load(), "options", None)
        if add is not None:
            add(parser)


ENTRIES: dict[str, Entry] = {
    "decoupling": Entry("decoupling", "suite"),
    "fetch": Entry("fetch", "suite"),
    "mesh": Entry("mesh", "suite"),
    "pixel": Entry("pixel", "suite"),
    "startup": Entry("startup", "suite"),
    "tests": Entry("own_tests", "suite"),
    "baselines": Entry("baselines", "suite"),
    "learning": Entry("learning", "suite"),
    "perception": Entry("perception", "suite"),
    "simulator": Entry("simulator", "suite"),
    "capture": Entry("capture", "suite"),
    "capture-format": Entry("capture_format", "suite"),
    "live": Entry("live", "suite"),
    "alarms": Entry("alarms"),
    "bus": Entry("bus"),
    "capture-damage": Entry("capture_damage"),
    "clocks": Entry("clocks"),
    "cockpit-hostile": Entry("cockpit_hostile"),
    "cockpit-network": Entry("cockpit_network"),
    "cockpit-newcomer": Entry("cockpit_newcomer"),
    "cockpit-pictures": Entry("cockpit_pictures"),
    "cockpit-screen": Entry("cockpit_screen"),
    "cockpit-stop": Entry("cockpit_stop"),
    "endings": Entry("endings"),
    "exports": Entry("exports"),
    "faults": Entry("faults"),
    "faults-live": Entry("faults_live"),
    "fuzz": Entry("fuzz"),
    "hardware-faults": Entry("hardware_faults"),
    "idle": Entry("idle"),
    "installs": Entry("installs"),
    "lerobot": Entry("lerobot"),
    "lost-control": Entry("lost_control"),
    "mend": Entry("mend"),
    "network": Entry("network"),
    "open": Entry("open_capture"),
    "planner": Entry("planner"),
    "policy": Entry("policy"),
    "pursuit": Entry("pursuit"),
    "readme": Entry("readme"),
    "rehearsals": Entry("rehearsals"),
    "rooms": Entry("rooms"),
    "scale": Entry("scale"),
    "servos": Entry("servos"),
    "site": Entry("site"),
    "site-chaos": Entry("site_chaos"),
    "site-cuts": Entry("site_cuts"),
    "site-frames": Entry("site_frames"),
    "site-intruders": Entry("site_intruders"),
    "site-latency": Entry("site_latency"),
    "site-soak": Entry("site_soak"),
    "starved": Entry("starved"),
    "stop": Entry("stop"),
    "stop-restarts": Entry("stop_restarts"),
    "viewer": Entry("viewer"),
}
