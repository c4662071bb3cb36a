"""`cocoro servos import`: a calibration by LeRobot goes into the robot's own file."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from math import degrees
from pathlib import Path
from typing import Any

import pytest
import tomlkit
from one_line import LINE, WHEELS, its, one_line, one_line_data
from wire_servos import ServoBench

from apps.cli.main import main
from cocoro.robot import Robot

ROBOT = one_line()
ELBOW, SHOULDER = its("elbow"), its("shoulder")
COMMANDED = [name for name, joint in ROBOT.joints.items() if joint.group is not None]
COUNT_DEG = degrees(ROBOT.joints[ELBOW].units.count_rad)
OFFSET = -100
Row = dict[str, Any]


def rows() -> dict[str, Row]:
    """A file for all servos, by LeRobot's names, whose ranges are the description's limits and 50 counts aside."""
    found = {}
    for number, name in enumerate((*COMMANDED, *WHEELS)):
        joint = ROBOT.joints[name]
        low, high = (0, 4095) if name in WHEELS else sorted(joint.to_count(end) + 50 for end in joint.limits_rad)
        row = {"id": joint.id, "drive_mode": 0, "homing_offset": OFFSET, "range_min": low, "range_max": high}
        found[f"motor_{number}"] = row
    return found


def of(found: dict[str, Row], joint: str) -> Row:
    return next(row for row in found.values() if row["id"] == ROBOT.joints[joint].id)


Import = Callable[..., int]


@pytest.fixture
def measured(tmp_path: Path) -> Path:
    return tmp_path / "robbie-measured.toml"


@pytest.fixture
def run(tmp_path: Path) -> Import:
    """Runs the command with a file's rows, or its text, and options; returns its exit code."""
    description, profile = tmp_path / "one.toml", tmp_path / "robbie.toml"
    description.write_text(tomlkit.dumps(plain(one_line_data())))
    profile.write_text(
        f'robot = "robbie"\nprocesses = ["servos"]\ndescription = "{description}"\nmeasured = "robbie-measured.toml"\n'
        f'\n[service.servos.ports]\n{LINE} = "{tmp_path / LINE}"\n'
    )

    def run(content: object, *options: str) -> int:
        file = tmp_path / "follower.json"
        file.write_text(content if isinstance(content, str) else json.dumps(content))
        return main(["servos", "import", str(file), "--profile", str(profile), *options])

    return run


def plain(value: Any) -> Any:
    """Without what TOML does not have."""
    if isinstance(value, dict):
        return {key: plain(inner) for key, inner in value.items() if inner is not None}
    return [plain(inner) for inner in value] if isinstance(value, list | tuple) else value


def test_the_robots_own_file_gets_the_joints_of_the_file(
    run: Import, measured: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    measured.write_text('# mine\n[[joint]]\nname = "its_elbow"\ndirection = -1\ntorque_nm = 1.5\n')
    content = rows()
    of(content, SHOULDER)["drive_mode"] = 1
    assert run(content) == 0
    out = capsys.readouterr().out
    assert f"left out: 'motor_9', {WHEELS[0]}: a wheel, which has neither zero nor limits" in out
    assert f"written to {measured}" in out
    assert "LeRobot's file does not tell it" in out
    assert "follower.json --check` shows their angles" in out
    assert "may be wrong" not in out
    assert measured.read_text().startswith("# mine\n")
    joints = Robot.load(tmp_path / "one.toml", measured).joints
    assert joints[ELBOW].torque_nm == 1.5
    for name in COMMANDED:
        joint, before = joints[name], ROBOT.joints[name]
        assert joint.direction == (-1 if name == SHOULDER else 1) * before.direction, name
        middle = sum(before.limits_rad) / 2
        assert joint.to_count(middle) == pytest.approx(before.to_count(middle) + 50, abs=2), name
        assert joint.limits_deg == pytest.approx((before.limits_deg[0] + 2, before.limits_deg[1] - 2), abs=0.3), name
    assert joints[WHEELS[0]] == ROBOT.joints[WHEELS[0]]
    text = measured.read_text()
    assert run(content) == 0
    assert measured.read_text() == text
    assert run(content, "--reverse", ELBOW) == 0
    assert Robot.load(tmp_path / "one.toml", measured).joints[ELBOW].direction == -ROBOT.joints[ELBOW].direction


def test_what_the_file_lacks_and_what_is_doubtful_is_told(
    run: Import, tmp_path: Path, measured: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    content = {name: row for name, row in rows().items() if row["id"] != ROBOT.joints[SHOULDER].id}
    of(content, ELBOW)["range_min"] += 400
    other = tmp_path / "other.toml"
    assert run(content, "--write", str(other)) == 0
    out = capsys.readouterr().out
    assert f"not in the file: {SHOULDER}" in out
    assert f"its zero may be wrong by {200 * COUNT_DEG:.0f} degrees" in out
    assert other.exists()
    assert not measured.exists()


def test_json_has_the_values_and_where_they_are(
    run: Import, measured: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(rows(), "--json") == 0
    told = json.loads(capsys.readouterr().out)
    assert told["written"] == str(measured)
    assert [one["joint"] for one in told["joints"]] == COMMANDED
    assert told["joints"][0].keys() >= {"motor", "id", "direction", "centre_count", "limits_deg", "angle_deg"}
    assert len(told["left_out"]) == len(WHEELS)


@pytest.mark.parametrize(
    ("content", "options", "code", "says"),
    [
        ("{", (), 2, "is no JSON"),
        ("[1]", (), 2, "is no calibration by LeRobot"),
        ({"one": {"id": 1}}, (), 2, "'one': Object missing required field"),
        (rows(), ("--line", "buss"), 2, f"there is no line 'buss'; known are {LINE}; did you mean {LINE}?"),
        (rows(), ("--reverse", "elbo"), 2, "there is no calibrated joint 'elbo' to reverse"),
        ({"one": {**rows()["motor_0"], "id": 99}}, (), 1, "calibrates no joint of this robot"),
    ],
)
def test_mistakes_get_one_line_and_change_nothing(
    run: Import,
    measured: Path,
    content: object,
    options: tuple[str, ...],
    code: int,
    says: str,
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert run(content, *options) == code
    error = capsys.readouterr().err
    assert says in error
    assert error.count("\n") == 1
    assert not measured.exists()


def test_a_file_that_is_not_there_gets_one_line(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    for path in (tmp_path / "none.json", tmp_path):
        assert main(["servos", "import", str(path)]) == 2
        error = capsys.readouterr().err
        assert f"{path} cannot be read: " in error
        assert error.count("\n") == 1


# --- compared with the servos ------------------------------------------------------------------------


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[ServoBench]:
    with ServoBench(tmp_path, protocol="feetech", robot=one_line()) as bench:
        for name in COMMANDED:
            bench.put(ROBOT.joints[name].id, offset=-OFFSET | 1 << 11)
        yield bench


@pytest.mark.zenoh  # each answer of the emulated wire must come within some real time
def test_servos_that_have_the_files_offsets_show_their_angles(
    bench: ServoBench, run: Import, measured: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    joint = ROBOT.joints[ELBOW]
    shaft = joint.to_count(0.3) + 50 + OFFSET
    bench.call(lambda: bench.body.turn_by_hand(joint.id, shaft))
    bench.emulator.until(lambda: bench.servo(joint.id).shaft == shaft)
    assert run(rows(), "--check", "--json") == 0
    told = json.loads(capsys.readouterr().out)
    angle = {one["joint"]: one["angle_deg"] for one in told["joints"]}
    assert angle[ELBOW] == pytest.approx(degrees(0.3), abs=0.3)
    assert None not in angle.values()
    assert told["written"] == str(measured)
    assert run(rows(), "--check") == 0
    assert "NOW, DEG" in capsys.readouterr().out.upper()


@pytest.mark.zenoh
def test_nothing_is_written_when_a_servo_differs_or_is_silent(
    bench: ServoBench, run: Import, measured: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    number = ROBOT.joints[ELBOW].id
    bench.put(number, offset=7)
    bench.call(lambda: setattr(bench.servo(ROBOT.joints[SHOULDER].id), "mute", True))
    assert run(rows(), "--check") == 1
    error = capsys.readouterr().err
    assert f"{ELBOW} (ID {number}) has the homing offset 7, in the file it is {OFFSET}" in error
    assert f"{SHOULDER} (ID {ROBOT.joints[SHOULDER].id}) does not answer" in error
    assert "nothing is written" in error
    assert not measured.exists()


def test_a_line_that_is_not_there_is_named(
    run: Import, measured: Path, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    assert run(rows(), "--check") != 0
    assert f"{tmp_path / LINE}: there is no such port" in capsys.readouterr().err
    assert not measured.exists()
