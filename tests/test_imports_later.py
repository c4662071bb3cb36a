"""What a component would import in the middle of its work is imported before."""

from __future__ import annotations

import asyncio
import subprocess
import sys

import pytest

from deploy import launch
from services.planning.component import PLANNING

DETOUR = """
import sys
from importlib import import_module
from pathlib import Path
sys.path.insert(0, "tests")
from planner_rig import started
planner = started()
for module in sys.argv[1:]:
    import_module(module)
before = set(sys.modules)
planner.points = tuple((0.5, 0.02 * place - 0.1, 0.3) for place in range(10))
planner.want("approach", "red_can")
assert "go around" in planner.run(1.0).why
print(*sorted(set(sys.modules) - before))
"""


def test_modules_are_imported_soon_after_the_start(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(launch, "SETTLED_S", 0.0)
    monkeypatch.delitem(sys.modules, "this_is_no_module", raising=False)
    monkeypatch.delitem(sys.modules, "colorsys", raising=False)
    asyncio.run(launch._import_later(("colorsys",)))
    assert "colorsys" in sys.modules
    with pytest.raises(ModuleNotFoundError):
        asyncio.run(launch._import_later(("this_is_no_module",)))


@pytest.mark.process
@pytest.mark.parametrize("ahead", [True, False], ids=["with what it names", "without"])
def test_a_planners_first_detour_imports_only_what_it_names(ahead: bool) -> None:
    names = PLANNING.imports_later if ahead else ()
    done = subprocess.run([sys.executable, "-c", DETOUR, *names], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert ("scipy.sparse" in done.stdout) is not ahead
    assert not ahead or not done.stdout.strip()
