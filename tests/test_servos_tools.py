"""Manual work on servos: scanning, IDs, zeros and limits; and the doctor's checks."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import replace
from math import degrees
from pathlib import Path

import pytest
from wire_servos import REPLY_S, ServoBench

from apps.cli.doctor import _own_checks
from apps.cli.main import main
from apps.cli.servos import ServoWorkbench
from cocoro.description import SERVO_COUNT_RAD
from cocoro.errors import RefusedError
from cocoro.robot import Robot
from deploy import profiles
from deploy.processes import named
from services.base.doctor import check as check_base
from services.base.service import BaseConfig
from services.servos import tools
from services.servos.bus import ServoBus
from services.servos.doctor import check as check_servos
from services.servos.service import ServosConfig
from sim.wire.create import EmulatedCreate
from sim.wire.emulator import Emulator

ROBOT = Robot.load()
ELBOW = ROBOT.joints["elbow"]


pytestmark = pytest.mark.zenoh  # each answer of the emulated wire must come within some real time


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[ServoBench]:
    with ServoBench(tmp_path) as bench:
        yield bench


@pytest.fixture
def line(bench: ServoBench) -> Iterator[ServoBus]:
    with ServoBus(bench.port("arm"), 1_000_000, REPLY_S) as line:
        yield line


def told(text: str) -> None:
    pass


def test_a_scan_finds_servos_at_every_baud_rate(bench: ServoBench, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tools, "SCAN_S", 0.1)
    bench.put(4, {4: 16, 5: 250})  # 117647 baud is 115200 to a port, nearly
    bench.put(4, {4: 3})  # 500000
    lines: list[str] = []
    found = list(tools.scan([bench.port("arm"), "/dev/nothing"], [1_000_000, 500_000], range(3, 6), lines.append))
    assert [(one.number, one.baud, one.model) for one in found] == [
        (3, 1_000_000, "RX-28"),
        (5, 1_000_000, "RX-28"),
        (4, 500_000, "RX-28"),
    ]
    assert found[2].return_delay_us == 500
    assert any("/dev/nothing: there is no such port" in line for line in lines)


def test_a_servo_gets_another_number_and_no_delay(bench: ServoBench, line: ServoBus) -> None:
    bench.call(lambda: bench.servo(5).put(5, 250))
    tools.set_number(line, 5, 50)
    assert bench.call(lambda: (bench.servo(50).get(3), bench.servo(50).get(5))) == (50, 0)
    tools.set_number(line, 50, 50)
    with pytest.raises(RefusedError, match="there is a servo 4 on this line already"):
        tools.set_number(line, 50, 4)
    with pytest.raises(RefusedError, match="no servo answers as 5: is it alone"):
        tools.set_number(line, 5, 6)


def by_hand(bench: ServoBench, *counts: int) -> Callable[[str], None]:
    """An operator who turns the elbow to the next position at each prompt."""
    left = list(counts)

    def turn(_: str) -> None:
        count = left.pop(0)
        bench.call(lambda: bench.body.turn_by_hand(5, count))
        bench.emulator.until(lambda: bench.servo(5).get(36) == count)

    return turn


@pytest.mark.parametrize(("turned", "direction", "centre"), [(700, 1, 600), (500, -1, 600)])
def test_zero_and_direction_come_from_two_turns_by_hand(
    bench: ServoBench, line: ServoBus, turned: int, direction: int, centre: float
) -> None:
    values = tools.calibrate(line, ELBOW, 0.0, by_hand(bench, 600, turned))
    assert values == {"direction": direction, "centre_count": centre}
    values = tools.calibrate(line, ELBOW, 30.0, by_hand(bench, 600, turned))
    assert values["centre_count"] == pytest.approx(600 - direction * 30.0 / degrees(SERVO_COUNT_RAD), abs=0.01)


def test_a_joint_that_was_not_turned_has_no_direction(bench: ServoBench, line: ServoBus) -> None:
    with pytest.raises(RefusedError, match=r"was turned by 1\.5 degrees only"):
        tools.calibrate(line, ELBOW, 0.0, by_hand(bench, 600, 605))


def test_limits_are_felt_from_end_to_end_and_written_into_the_servo(bench: ServoBench, line: ServoBus) -> None:
    turn = by_hand(bench, 300, 800)
    turns = iter([True, True, False])  # two ends, then a pause before Return is pressed

    def done() -> bool:
        turned = next(turns, None)
        if turned:
            turn("")
        return turned is None

    limits = tools.feel_limits(line, ELBOW, done, told)
    first, last = (degrees(ELBOW.to_angle(count)) for count in (300, 800))
    assert limits == pytest.approx((first + 2.0, last - 2.0), abs=0.1)
    low, high = tools.write_limits(line, ELBOW, limits)
    assert (bench.servo(5).get(6), bench.servo(5).get(8)) == (low, high)
    assert 300 < low < high < 800


# --- the commands -----------------------------------------------------------------------------------


@pytest.fixture
def profile(bench: ServoBench, tmp_path: Path) -> Path:
    path = tmp_path / "robbie.toml"
    path.write_text(
        'robot = "robbie"\nprocesses = ["servos"]\nmeasured = "robbie-measured.toml"\n\n[service.servos]\n'
        f'arm_port = "{bench.port("arm")}"\nhand_port = "{bench.port("hand")}"\n'
    )
    return path


def test_calibrating_writes_the_robots_own_file(
    bench: ServoBench, profile: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("builtins.input", by_hand(bench, 600, 500))
    assert main(["servos", "calibrate", "elbow", "--profile", str(profile)]) == 0
    measured = profile.with_name("robbie-measured.toml")
    assert str(measured) in capsys.readouterr().out
    elbow = Robot.load(override=measured).joints["elbow"]
    assert (elbow.direction, elbow.centre_count) == (-1, 600.0)


def test_a_calibration_is_shown_even_if_its_file_cannot_be_written(
    bench: ServoBench, profile: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("builtins.input", by_hand(bench, 600, 500))
    broken = profile.with_name("broken.toml")
    broken.write_text("[[joint]\n")
    assert main(["servos", "calibrate", "elbow", "--profile", str(profile), "--write", str(broken)]) == 2
    shown = capsys.readouterr()
    assert "elbow: direction = -1, centre_count = 600" in shown.out
    assert '[[joint]]: name = "elbow", direction = -1, centre_count = 600.0' in shown.err
    assert broken.read_text() == "[[joint]\n"


def test_the_tools_take_another_robots_files(
    bench: ServoBench, profile: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    other = tmp_path / "other.toml"
    other.write_text('[[joint]]\nname = "elbow"\nid = 15\n')
    assert ServoWorkbench.of(str(profile), None, measured=other).robot.joints["elbow"].id == 15
    assert main(["servos", "limits", "elbow", "--profile", str(profile), "--description", str(tmp_path / "no")]) == 2
    assert "robot description" in capsys.readouterr().err


def test_a_scan_names_what_is_missing_and_writes_ports_where_it_is_told(
    bench: ServoBench, profile: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(tools, "SCAN_S", 0.1)
    monkeypatch.setattr(tools, "candidates", list)
    bench.call(lambda: setattr(bench.servo(9), "mute", True))
    copy = profile.with_name("copy.toml")
    arguments = ["servos", "scan", "--profile", str(profile), "--baud", "1000000", "--last", "9"]
    assert main([*arguments, "--write", str(copy)]) == 1
    shown = capsys.readouterr().out
    assert "claw_left" in shown
    assert "not found: claw_right (ID 9)" in shown
    assert f'hand_port = "{bench.port("hand")}"' in copy.read_text()
    assert main([*arguments, "--json"]) == 1
    assert [one["number"] for one in json.loads(capsys.readouterr().out)] == [1, 2, 3, 4, 5, 6, 7, 8]


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["calibrate", "elbo"], "there is no joint 'elbo'; known are neck_pan,"),
        (["calibrate", "elbow", "--port", "/dev/nothing"], "/dev/nothing: there is no such port"),
        (["set-id", "5", "4", "--port", "PORT"], "there is a servo 4 on this line already"),
    ],
)
def test_mistakes_get_one_line(
    bench: ServoBench, profile: Path, arguments: list[str], says: str, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = [bench.port("arm") if one == "PORT" else one for one in arguments]
    extra = [] if arguments[0] == "set-id" else ["--profile", str(profile)]
    assert main(["servos", *arguments, *extra]) != 0
    error = capsys.readouterr().err
    assert says in error
    assert error.count("\n") == 1


# --- the doctor -------------------------------------------------------------------------------------


def test_the_doctor_looks_at_every_servo(bench: ServoBench) -> None:
    config = ServosConfig(arm_port=bench.port("arm"), hand_port=bench.port("hand"), reply_s=REPLY_S)
    assert {check.state for check in check_servos(config, ROBOT, "robbie")} == {"ok"}
    bench.call(lambda: setattr(bench.servo(9), "mute", True))
    for number, registers in {5: {5: 250}, 4: {43: 75}, 3: {42: 70}}.items():
        bench.put(number, registers)
    texts = {check.name: check.text for check in check_servos(config, ROBOT, "robbie") if check.state == "bad"}
    assert "answers after 500 us" in texts["servo 5, elbow"]
    assert "let it cool" in texts["servo 4, shoulder"]
    assert "bad voltage" in texts["servo 3, arm_base"]
    assert "does not answer at 1000000 baud" in texts["servo 9, claw_right"]


def test_the_doctor_talks_to_the_create(tmp_path: Path) -> None:
    create = EmulatedCreate()
    config = BaseConfig(port=str(tmp_path / "create"))
    still = type("Still", (), {"advance": lambda self, now_ns: None, "fileno": lambda self: -1})()
    with Emulator(tmp_path, {"create": create}, still) as emulator:
        checks = {check.name: check for check in check_base(config, ROBOT, "robbie")}
        assert checks["Create"].text == "answers, passive mode"
        assert checks["battery"].text.startswith("85%, 15.8 V")
        create.sensors.charge_mah = 100
        create.sensors.drop_left = True
        checks = {check.name: check for check in check_base(config, ROBOT, "robbie")}
        assert "charge it" in checks["battery"].text
        assert checks["wheels"].state == "bad"
        emulator.call(lambda: setattr(create, "powered", False))
        checks = {check.name: check for check in check_base(config, ROBOT, "robbie")}
        assert "switch it on" in checks["Create"].text
    assert "plug the adapter in" in check_base(config, ROBOT, "robbie")[0].text


@pytest.mark.parametrize("module", ["nowhere.service", "services.base.nothing"])
def test_the_doctor_names_a_component_that_is_not_installed(module: str) -> None:
    missing = replace(named("base"), module=module)
    (check,) = _own_checks(missing, profiles.read("robot"), ROBOT)
    assert (check.name, check.state) == ("base", "bad")
    assert f"there is no module {module}" in check.text


def test_the_whole_doctor_prints_a_line_a_check(
    bench: ServoBench,
    profile: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
) -> None:
    monkeypatch.setenv("COCORO_RUN_DIR", str(tmp_path / "run"))
    assert main(["doctor", str(profile)]) == 1
    assert "robbie-measured.toml" in capsys.readouterr().out  # which is named, and not there
    profile.with_name("robbie-measured.toml").write_text("")
    main(["doctor", str(profile), "--json"])
    checks = json.loads(capsys.readouterr().out)
    by_name = {check["name"]: check for check in checks}
    assert by_name["servo 5, elbow"]["state"] == "ok"
    other = tmp_path / "other.toml"
    other.write_text('[[joint]]\nname = "elbow"\nid = 15\n')
    main(["doctor", str(profile), "--json", "--measured", str(other)])
    assert "servo 15, elbow" in {check["name"] for check in json.loads(capsys.readouterr().out)}
    assert by_name["dynamixel-sdk"]["state"] == "ok"
    main(["doctor", str(profile)])
    assert len(capsys.readouterr().out.splitlines()) == len(checks)
