"""Manual work on servos: scanning, IDs, zeros and limits; and the doctor's checks."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Callable, Iterator
from dataclasses import replace
from math import degrees
from pathlib import Path

import pytest
from wire_servos import REPLY_S, WHEEL, ServoBench

from apps.cli.doctor import _own_checks
from apps.cli.main import main
from apps.cli.servo_bench import ServoWorkbench
from cocoro.errors import RefusedError
from cocoro.robot import Robot
from cocoro.servo_units import UNITS, Protocol
from deploy import profiles
from deploy.processes import named
from services.base.doctor import check as check_base
from services.base.service import BaseConfig
from services.servos import tools
from services.servos.bus import ServoBus, SilentError
from services.servos.doctor import check as check_servos
from services.servos.feetech import FEETECH
from services.servos.service import ServosConfig
from sim.wire.create import EmulatedCreate
from sim.wire.dynamixel import EmulatedDynamixel
from sim.wire.emulator import Emulator, SimplePlant
from sim.wire.feetech import EmulatedFeetech
from sim.wire.line import LineFault
from sim.wire.servo import EmulatedServoBus

ROBOT = Robot.load()
FOREVER_NS = 10**19


pytestmark = pytest.mark.zenoh  # each answer of the emulated wire must come within some real time


both = pytest.mark.parametrize("bench", UNITS, indirect=True)
"""A test of both families; the others are of Dynamixels."""
CODES = {"dynamixel": 3, "feetech": 1}
"""The values of the register `baud` for 500,000."""


@pytest.fixture
def bench(tmp_path: Path, request: pytest.FixtureRequest) -> Iterator[ServoBench]:
    protocol: Protocol = getattr(request, "param", "dynamixel")
    with ServoBench(tmp_path, protocol=protocol) as bench:
        yield bench


@pytest.fixture
def line(bench: ServoBench) -> Iterator[ServoBus]:
    with bench.bus(tries=tools.TRIES) as line:
        yield line


def told(text: str) -> None:
    pass


@both
def test_a_scan_finds_servos_at_every_baud_rate(bench: ServoBench, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tools, "SCAN_S", 0.1)
    protocol = bench.family.protocol
    bench.put(4, baud=CODES[protocol], return_delay=250)
    lines: list[str] = []
    found = list(tools.scan([bench.port("arm"), "/dev/nothing"], [1_000_000, 500_000], range(3, 6), lines.append))
    kind = {"dynamixel": "RX-28", "feetech": "STS3215"}[protocol], protocol
    assert [(one.number, one.baud, one.model, one.protocol) for one in found] == [
        (3, 1_000_000, *kind),
        (5, 1_000_000, *kind),
        (4, 500_000, *kind),
    ]
    assert found[2].return_delay_us == 500
    assert any("/dev/nothing: there is no such port" in line for line in lines)


def test_a_scan_tells_the_families_on_one_line_from_each_other(tmp_path: Path) -> None:
    bus = EmulatedServoBus([EmulatedDynamixel(1), EmulatedFeetech(2), EmulatedDynamixel(3, 28), EmulatedFeetech(4)])
    bus.servos[0].put(0, 999)  # models that nobody knows
    bus.servos[3].put(3, 999)
    with Emulator(tmp_path, {"line": bus}, SimplePlant(None, bus)), ServoBus(str(tmp_path / "line"), 1_000_000) as line:
        found = [tools.examine(line, 0, number) for number in range(1, 7) if tools.recognise(line, number)]
        assert [(one.model, one.protocol) for one in found] == [
            ("model 999", "dynamixel"),
            ("STS3215", "feetech"),
            ("RX-28", "dynamixel"),
            ("model 999", "feetech"),
        ]
        assert line.family is FEETECH  # nobody answered as 5 and 6


@both
def test_a_servo_gets_another_number_and_no_delay(bench: ServoBench, line: ServoBus) -> None:
    bench.put(5, return_delay=250)
    line.family = FEETECH  # the servo says what it is
    tools.set_number(line, 5, 50)
    bench.call(bench.servo(50).power_up)  # it keeps them
    assert bench.call(lambda: (bench.get(50, "id"), bench.get(50, "return_delay"))) == (50, 0)
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
        bench.emulator.until(lambda: bench.servo(5).shaft == count)

    return turn


@both
@pytest.mark.parametrize(("turned", "direction"), [(700, 1), (500, -1)])
def test_zero_and_direction_come_from_two_turns_by_hand(
    bench: ServoBench, line: ServoBus, turned: int, direction: int
) -> None:
    elbow = bench.robot.joints["elbow"]
    centre = 600 if bench.family.centring is None else 2048
    values = tools.calibrate(line, elbow, 0.0, by_hand(bench, 600, turned))
    assert values == {"direction": direction, "centre_count": centre}
    values = tools.calibrate(line, elbow, 30.0, by_hand(bench, 600, turned))
    there = direction * 30.0 / degrees(elbow.units.count_rad)
    assert values["centre_count"] == pytest.approx(centre - there, abs=0.01)


@both
def test_a_lost_packet_ends_no_calibration(bench: ServoBench) -> None:
    wire = bench.emulator.lines["arm"]
    bench.call(lambda: wire.disturb(LineFault("truncated", 0.05, "to_driver", FOREVER_NS)))
    elbow = bench.robot.joints["elbow"]
    with bench.bus(tries=tools.TRIES) as line:
        assert tools.calibrate(line, elbow, 0.0, by_hand(bench, 600, 700))["direction"] == 1
    with bench.bus(reply_s=0.02) as once, pytest.raises(SilentError):
        _ = [once.reading(elbow.id) for _ in range(200)]


@both
def test_a_joint_that_was_not_turned_has_no_direction(bench: ServoBench, line: ServoBus) -> None:
    said = f"was turned by {degrees(5 * bench.units.count_rad):.1f} degrees only"
    with pytest.raises(RefusedError, match=said):
        tools.calibrate(line, bench.robot.joints["elbow"], 0.0, by_hand(bench, 600, 605))


@pytest.mark.parametrize("bench", ["feetech"], indirect=True)
def test_a_calibrated_servo_passes_no_end_of_its_range_and_remembers_it(bench: ServoBench, line: ServoBus) -> None:
    elbow = bench.robot.joints["elbow"]
    turn = by_hand(bench, 4050, 4140)  # from the last positions to the first ones
    with pytest.raises(RefusedError, match="elbow passed the end of its servo's range"):
        tools.feel_limits(line, elbow, lambda: bool(turn("")), print)
    tools.calibrate(line, elbow, 0.0, by_hand(bench, 4090, 4200))
    bench.call(bench.servo(5).power_up)
    assert line.reading(5).position == 2048 + 110


@both
def test_limits_are_felt_from_end_to_end_and_written_into_the_servo(bench: ServoBench, line: ServoBus) -> None:
    turn = by_hand(bench, 300, 800)
    turns = iter([True, True, False])  # two ends, then a pause before Return is pressed

    def done() -> bool:
        turned = next(turns, None)
        if turned:
            turn("")
        return turned is None

    elbow = bench.robot.joints["elbow"]
    limits = tools.feel_limits(line, elbow, done, told)
    first, last = (degrees(elbow.to_angle(count)) for count in (300, 800))
    assert limits == pytest.approx((first + 2.0, last - 2.0), abs=0.1)
    low, high = tools.write_limits(line, elbow, limits)
    bench.call(bench.servo(5).power_up)
    assert (bench.get(5, "low_limit"), bench.get(5, "high_limit")) == (low, high)
    assert 300 < low < high < 800


# --- the commands -----------------------------------------------------------------------------------


@pytest.fixture
def profile(bench: ServoBench, tmp_path: Path) -> Path:
    path = tmp_path / "robbie.toml"
    path.write_text(
        'robot = "robbie"\nprocesses = ["servos"]\nmeasured = "robbie-measured.toml"\n\n[service.servos.ports]\n'
        f'arm = "{bench.port("arm")}"\nhand = "{bench.port("hand")}"\n'
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
    assert tomllib.loads(copy.read_text())["service"]["servos"]["ports"]["hand"] == bench.port("hand")
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


@pytest.mark.parametrize("bench", ["feetech"], indirect=True)
def test_a_scan_writes_what_protocol_it_found_and_the_other_commands_speak_it(
    bench: ServoBench, profile: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(tools, "SCAN_S", 0.1)
    monkeypatch.setattr(tools, "candidates", list)
    arguments = ["servos", "scan", "--profile", str(profile), "--baud", "1000000", "--last", "9"]
    assert main([*arguments, "--write", str(profile)]) == 0
    assert "its protocol, feetech, is written to" in capsys.readouterr().out
    robot = Robot.load(override=profile.with_name("robbie-measured.toml"))
    assert {row.protocol for row in robot.networks.values()} == {"feetech"}
    monkeypatch.setattr("builtins.input", by_hand(bench, 600, 500))
    assert main(["servos", "calibrate", "elbow", "--profile", str(profile)]) == 0
    assert "elbow: direction = -1, centre_count = 2048" in capsys.readouterr().out
    assert main(["servos", "set-id", "5", "15", "--port", bench.port("arm")]) == 0
    assert bench.call(lambda: bench.get(15, "id")) == 15


# --- the doctor -------------------------------------------------------------------------------------


@both
def test_the_doctor_looks_at_every_servo(bench: ServoBench) -> None:
    config = ServosConfig(port=f"{bench.folder}/{{line}}", reply_s=REPLY_S)
    assert {check.state for check in check_servos(config, bench.robot, "robbie")} == {"ok"}
    bench.call(lambda: setattr(bench.servo(9), "mute", True))
    bench.put(5, return_delay=250)
    bench.put(4, temperature=75)
    bench.put(3, voltage=180)
    bench.put(2, **WHEEL[bench.family.protocol])
    texts = {check.name: check.text for check in check_servos(config, bench.robot, "robbie") if check.state == "bad"}
    assert "answers after 500 us" in texts["servo 5, elbow"]
    assert "let it cool" in texts["servo 4, shoulder"]
    assert "bad voltage" in texts["servo 3, arm_base"]
    assert "is set up as a wheel" in texts["servo 2, neck_tilt"]
    assert "does not answer at 1000000 baud" in texts["servo 9, claw_right"]
    other = bench.robot.with_networks(protocol={"dynamixel": "feetech", "feetech": "dynamixel"}[bench.family.protocol])
    checks = check_servos(config, other, "robbie")
    assert f"it speaks {bench.family.protocol}, but" in next(one.text for one in checks if one.name == "servo 5, elbow")


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
