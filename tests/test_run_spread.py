"""`pytest --spread`: every test runs once, beside what it may run beside, and the death of a worker is told."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from run_spread import WORKERS, jobs_by_kind

from bench.own_tests import RECORD

HERE = Path(__file__).parent
CONFTEST = """
import os, time
import pytest
pytest_plugins = ["run_record", "run_spread"]

@pytest.fixture(autouse=True)
def noted(request):
    begun = time.monotonic()
    yield
    with open("noted", "a") as file:
        file.write(f"{request.node.name} {os.getpid()} {begun} {time.monotonic()} {os.sched_getscheduler(0)}\\n")
"""
FILES = {
    "test_computes.py": "def test_well(): pass\ndef test_badly(): assert 1 + 1 == 3\n",
    "test_dies.py": "import os\ndef test_before(): pass\ndef test_dies(): os._exit(7)\ndef test_after(): pass\n",
    "test_later.py": "def test_later(tmp_path): assert tmp_path.is_dir()\n",
    "test_meets.py": "import pytest\npytestmark = pytest.mark.zenoh\ndef test_meets(): pass\n",
    "test_times.py": "import pytest\npytestmark = [pytest.mark.zenoh, pytest.mark.alone]\n"
    "def test_times(): pass\ndef test_times_too(): pass\n",
}


@pytest.fixture(scope="module")
def ran(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, subprocess.CompletedProcess[str]]:
    folder = tmp_path_factory.mktemp("spread")
    (folder / "conftest.py").write_text(CONFTEST)
    (folder / "pytest.ini").write_text("[pytest]\nmarkers =\n  zenoh\n  alone\n")
    for name, text in FILES.items():
        (folder / name).write_text(text)
    path = os.pathsep.join((str(HERE), str(HERE.parent)))
    environment = os.environ | {"PYTHONPATH": path, "COCORO_TESTS_RECORD": str(folder / "new")}
    command = [sys.executable, "-m", "pytest", "--spread", "-q", "-p", "no:cacheprovider", "--tb=line", "-rA"]
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)
    return folder, done


@pytest.mark.process
def test_every_test_ends_once_as_without_workers(ran: tuple[Path, subprocess.CompletedProcess[str]]) -> None:
    _, done = ran
    words = [line.split() for line in done.stdout.splitlines()]
    ends = [(each[1].partition("::")[2], each[0]) for each in words if len(each) > 1 and "::" in each[1]]
    assert sorted(ends) == [
        ("test_after", "FAILED"), ("test_badly", "FAILED"), ("test_before", "PASSED"), ("test_dies", "FAILED"),
        ("test_later", "PASSED"), ("test_meets", "PASSED"), ("test_times", "PASSED"), ("test_times_too", "PASSED"),
        ("test_well", "PASSED"),
    ], done.stdout + done.stderr  # fmt: skip
    assert done.returncode == 1
    assert "while this test ran (exit code 7)" in done.stdout
    assert "before this test (exit code 7)" in done.stdout


@pytest.mark.process
def test_what_measures_time_runs_before_what_would_disturb_it(
    ran: tuple[Path, subprocess.CompletedProcess[str]],
) -> None:
    rows = [line.split() for line in (ran[0] / "noted").read_text().splitlines()]
    noted = {name: (int(pid), float(begun), float(ended), int(policy)) for name, pid, begun, ended, policy in rows}
    assert noted["test_times"][2] <= noted["test_times_too"][1]
    assert noted["test_times_too"][2] <= noted["test_meets"][1]
    here = os.sched_getscheduler(0)
    assert noted["test_times"][3] == noted["test_meets"][3] == here
    assert {noted[name][3] for name in ("test_well", "test_badly", "test_before", "test_later")} == {os.SCHED_IDLE}


@pytest.mark.process
def test_the_run_leaves_a_record(ran: tuple[Path, subprocess.CompletedProcess[str]]) -> None:
    (part,) = (ran[0] / "new").glob("pytest-*.json")
    files = json.loads(part.read_text())["files"]
    assert set(files) == set(FILES)
    assert files["test_times.py"]["tests"] == 2
    assert all(0 <= figures["processor_s"] < 60 for figures in files.values())
    assert files["test_later.py"]["memory_mb"] > 5
    tests_s = json.loads(part.read_text())["tests_s"]
    assert len(tests_s) == sum(figures["tests"] for figures in files.values())
    assert RECORD.name == "last"


def test_a_test_is_in_one_job(request: pytest.FixtureRequest) -> None:
    items = request.session.items
    jobs = jobs_by_kind(items)
    assert set(jobs) == set(WORKERS)
    placed = [item.nodeid for of_kind in jobs.values() for job in of_kind for item in job.items]
    assert sorted(placed) == sorted(item.nodeid for item in items)
