"""Profiles: those of the project, overrides, and the errors of a faulty one."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import msgspec
import pytest

from cocoro.errors import ConfigError
from deploy import profiles
from deploy.rundir import RunDir


class Config(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    pace_hz: Annotated[float, msgspec.Meta(gt=0)] = 1.0


def written(folder: Path, text: str) -> str:
    path = folder / "mine.toml"
    path.write_text(text)
    return str(path)


@pytest.mark.parametrize("name", profiles.names())
def test_the_profiles_that_come_along_are_good(name: str) -> None:
    assert profiles.read(name).name == name


@pytest.mark.parametrize("name", ["sim", "robot"])
def test_simulated_or_real_a_robot_has_all_its_services(name: str) -> None:
    wanted = {"kinect", "base", "arm", "hand", "perception", "planning", "executive"}
    assert wanted <= set(profiles.read(name).services())


def test_the_simulated_robot_follows_the_simulators_clock_and_the_real_one_its_own() -> None:
    assert profiles.read("sim").clock == "sim"
    assert profiles.read("robot").clock == "real"


def test_overrides_are_values_as_in_toml_or_plain_text() -> None:
    simulator = ["service.sim.seed=3", "service.sim.scene=my.toml", 'service.sim.sensors="real"']
    profile = profiles.read("sim", [*simulator, "service.planning.latency_s=0.5", "robot=robbie", "mesh.lease_s=2"])
    assert profile.service["sim"] == {"scene": "my.toml", "seed": 3, "sensors": "real"}
    assert profile.launch("planning").latency_s == 0.5
    assert profile.launch("sim") == profiles.Launch()
    assert (profile.robot, profile.mesh.lease_s) == ("robbie", 2.0)


@pytest.mark.parametrize("override", ["seed", "=3", "service..seed=3", "robot.name=robbie"])
def test_an_override_that_is_none_says_so(override: str) -> None:
    with pytest.raises(ConfigError, match=r"is not a setting; write it as|is a value, not a table"):
        profiles.read("sim", [override])


def test_a_services_table_becomes_its_config(tmp_path: Path) -> None:
    table = "[service.planning]\npace_hz = 2\nlatency_s = 0.1\nrecord_steps = true\n"
    profile = profiles.read(written(tmp_path, f'robot = "r"\nprocesses = ["planning"]\n{table}'))
    assert profile.config("planning", Config) == Config(pace_hz=2.0)
    assert profile.launch("planning") == profiles.Launch(latency_s=0.1, record_steps=True)


def test_a_setting_that_every_component_has_is_none_of_a_components_own() -> None:
    class Slow(msgspec.Struct):
        latency_s: float = 0.0

    with pytest.raises(ConfigError, match=r"component planning: .* latency_s: rename"):
        profiles.read("sim").config("planning", Slow)


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ("pace_hz = 'fast'", r"\[service.planning\]: pace_hz: Expected `float`, got `str`"),
        ("pace_hz = 0", r"\[service.planning\]: pace_hz: Expected `float` > 0.0"),
        ("pase_hz = 1", r"\[service.planning\]: unknown field 'pase_hz'; .*did you mean pace_hz"),
    ],
)
def test_a_mistake_in_a_services_table_names_profile_table_and_field(tmp_path: Path, table: str, message: str) -> None:
    path = written(tmp_path, f'robot = "r"\nprocesses = ["planning"]\n[service.planning]\n{table}')
    profile = profiles.read(path)
    with pytest.raises(ConfigError, match=message) as raised:
        profile.config("planning", Config)
    assert path in str(raised.value)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("robot = ", r"mine.toml: Invalid value"),
        ('processes = ["planning"]', r"missing required field `robot`"),
        ('robot = "R 2"\nprocesses = ["planning"]', r"robot: a name has 1 to 32 small letters, digits, '-' and '_'"),
        ('robot = "r"\nprocesses = ["sim"]\n[service.Sim]', r"service: a name has 1 to 32 small letters"),
        ('robot = "r"\nprocesses = []', r"processes: Expected `array` of length >= 1"),
        ('robot = "r"\nprocesses = ["plannning"]', r"no process 'plannning'; known are"),
        ('robot = "r"\nprocesses = ["planning", "planning"]', r"names a process twice"),
        ('robot = "r"\nprocesses = ["base", "sim"]', r"base and sim both provide base"),
        ('robot = "r"\nprocesses = ["sim"]\nclock = "fast"', r"clock: unknown value 'fast'; known are sim, real"),
        ('robot = "r"\nprocesses = ["sim"]\n[service.simm]', r"no process 'simm'"),
        ('robot = "r"\nprocesses = ["sim"]\n[service.sim]\nlatency_s = -1', r"\[service.sim\]: latency_s: Expected"),
        ('robot = "r"\nprocesses = ["sim"]\n[mesh]\nconect = []', r"mesh: Object contains unknown field `conect`"),
    ],
)
def test_a_mistake_in_a_profile_says_where(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        profiles.read(written(tmp_path, text))


def test_a_profile_that_is_not_there_lists_those_that_are(tmp_path: Path) -> None:
    with pytest.raises(
        ConfigError, match=r"no profile 'simm', and .* a .toml file; known are .*robot, sim.*did you mean sim"
    ):
        profiles.read("simm")
    with pytest.raises(ConfigError, match=r"no profile file .*mine.toml"):
        profiles.read(str(tmp_path / "mine.toml"))


def test_a_profiles_own_files_are_found_from_anywhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    written(tmp_path, 'robot = "r"\nprocesses = ["sim"]\nmeasured = "measured.toml"')
    assert profiles.read("./mine.toml").measured == str(tmp_path / "measured.toml")


def test_it_meets_in_the_run_directory_with_its_own_patience(short_path: Path) -> None:
    patient = written(short_path, 'robot = "r"\nprocesses = ["sim"]\n[mesh]\nlease_s = 7.0')
    here = RunDir("r", short_path).join_as("planning", profiles.read(patient).mesh)
    assert (here.directory, here.name, here.lease_s) == (short_path / "r", "planning", 7.0)


def test_a_profile_survives_being_written_and_read_as_json() -> None:
    profile = profiles.read("sim", ["service.sim.seed=3"])
    assert profiles.from_data(msgspec.json.decode(msgspec.json.encode(profile)), "sim") == profile
