"""Measured values and objects are put where they belong, and nothing else in the file changes."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from apps.cli.toml_files import with_values, write_values
from cocoro.errors import ConfigError
from cocoro.robot import Robot

FILE = """# Robbie's own.
name = "robbie"

[base]
wheel_separation_m = 0.2583   # measured with a ruler

# The elbow was mounted askew.
[[joint]]
name = "elbow"
centre_count = 500.0   # by hand

[[joint]]
name = "shoulder"
direction = -1
"""


def test_a_value_in_a_row_is_replaced_and_its_comment_stays() -> None:
    text = with_values(FILE, "joint", {"centre_count": 507.25, "direction": -1}, "elbow")
    assert "centre_count = 507.25   # by hand\ndirection = -1\n\n[[joint]]" in text
    assert "# The elbow was mounted askew." in text
    rows = {row["name"]: row for row in tomllib.loads(text)["joint"]}
    assert rows["elbow"]["direction"] == -1
    assert rows["shoulder"] == {"name": "shoulder", "direction": -1}


def test_a_new_row_and_a_new_table_come_at_the_end() -> None:
    text = with_values(FILE, "joint", {"limits_deg": (-120.0, 99.5)}, "neck_pan")
    text = with_values(text, "service.servos", {"arm_port": "/dev/ttyUSB0"})
    data = tomllib.loads(text)
    assert data["joint"][-1] == {"name": "neck_pan", "limits_deg": [-120.0, 99.5]}
    assert data["service"]["servos"]["arm_port"] == "/dev/ttyUSB0"
    assert text.startswith(FILE)


def test_a_table_is_changed_in_its_place() -> None:
    text = with_values(FILE, "base", {"wheel_separation_m": 0.26})
    assert "wheel_separation_m = 0.26   # measured with a ruler" in text
    assert text.count("wheel_separation_m") == 1


def test_an_empty_file_becomes_one_that_the_robot_can_be_loaded_with(tmp_path: Path) -> None:
    path = tmp_path / "new" / "measured.toml"
    write_values(path, "joint", {"centre_count": 530.0, "id": 15}, "elbow")
    robot = Robot.load(override=path)
    assert (robot.joints["elbow"].id, robot.joints["elbow"].centre_count) == (15, 530.0)


def test_a_file_that_is_no_toml_is_left_alone(tmp_path: Path) -> None:
    path = tmp_path / "broken.toml"
    path.write_text("name = ")
    with pytest.raises(ConfigError, match=r"broken.toml is not changed: not valid TOML") as refused:
        write_values(path, "joint", {"id": 1, "limits_deg": (-1.5, 2.0)}, "elbow")
    assert path.read_text() == "name = "
    assert '[[joint]]: name = "elbow", id = 1, limits_deg = [-1.5, 2.0]' in str(refused.value), "nothing is lost"


def test_a_file_that_cannot_be_written_gives_the_values_back(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(ConfigError, match=r"is not changed: File exists.*baud = 57600"):
        write_values(tmp_path / "file" / "own.toml", "network.arm", {"baud": 57600})


@pytest.mark.parametrize(
    "text",
    [
        "[ kinect ]\nrate_hz = 1.0\n",
        "[kinect] # the sensor\n",
        "kinect = { rate_hz = 1.0, width = 640 }\n",
        "kinect.rate_hz = 1.0\nname = 'x'\n[base]\n",
        '["kinect"]\n"rate_hz" = 1.0\n',
        "[kinect]\nmount_min_m = [\n  1.0, # x\n  2.0,\n  3.0\n]\nrate_hz = 1.0\n# end",
        '[base]\nx = "it\'s a # \\"quote\\" [kinect]"\n',
        "[kinect]\r\nrate_hz = 1.0\r\n\r\n# the base\r\n[base]\r\n",
    ],
)
def test_every_legal_way_to_write_a_table_is_edited(text: str) -> None:
    before = tomllib.loads(text)
    after = tomllib.loads(with_values(text, "kinect", {"rate_hz": 15.0, "depth_offset_m": (0.1, 0.0, -0.2)}))
    measured = {"rate_hz": 15.0, "depth_offset_m": [0.1, 0.0, -0.2]}
    assert after == before | {"kinect": before.get("kinect", {}) | measured}


def test_new_values_stand_before_the_comment_on_what_follows() -> None:
    text = with_values(FILE, "base", {"wheel_radius_m": 0.0305})
    assert "with a ruler\nwheel_radius_m = 0.0305\n\n# The elbow was mounted askew.\n[[joint]]" in text


def test_a_table_that_is_something_else_is_named() -> None:
    with pytest.raises(ConfigError, match="kinect is no table"):
        with_values("kinect = 1\n", "kinect", {"rate_hz": 15.0})
    with pytest.raises(ConfigError, match="joint is no list of tables"):
        with_values("[joint]\n", "joint", {"id": 1}, "elbow")


# --- any legal file -------------------------------------------------------------------------------

KEYS = st.sampled_from(["joint", "kinect", "network", "arm", "name", "baud", "a b", "x.y", "", "é", '"'])
SCALARS = (
    st.integers(-(2**31), 2**31)
    | st.floats(allow_nan=False)
    | st.booleans()
    | st.text(st.characters(blacklist_categories=["Cs"]), max_size=6)
)
VALUES = st.recursive(
    SCALARS, lambda inner: st.lists(inner, max_size=3) | st.dictionaries(KEYS, inner, max_size=3), max_leaves=8
)


def basic(text: str) -> str:
    escaped = "".join(char if char.isprintable() and char not in '"\\' else f"\\U{ord(char):08x}" for char in text)
    return f'"{escaped}"'


class Emitter:
    """Writes data as TOML in one of the many ways that are legal, drawn at random; collects its comments."""

    def __init__(self, draw: st.DrawFn) -> None:
        self.draw = draw
        self.comments: list[str] = []

    def pick(self, *options: str) -> str:
        return self.draw(st.sampled_from(options))

    def key(self, key: str) -> str:
        bare = bool(key) and key.isascii() and key.replace("-", "_").isidentifier()
        return key if bare and self.draw(st.booleans()) else basic(key)

    def comment(self) -> str:
        if self.pick("none", "some") == "none":
            return ""
        self.comments.append(f'# c{len(self.comments)} [joint] = "')
        return self.comments[-1]

    def value(self, value: object) -> str:
        if isinstance(value, bool):
            return "true" if value else "false"
        if isinstance(value, str):
            return f"'{value}'" if value.isalnum() and self.draw(st.booleans()) else basic(value)
        if isinstance(value, list):
            if self.pick("line", "lines") == "line" or not value:
                return f"[{', '.join(map(self.value, value))}]"
            return "[\n" + "".join(f"    {self.value(one)}, {self.comment()}\n" for one in value) + "]"
        if isinstance(value, dict):
            return f"{{{', '.join(f'{self.key(key)} = {self.inline(one)}' for key, one in value.items())}}}"
        return repr(value)

    def inline(self, value: object) -> str:
        if isinstance(value, list):
            return f"[{', '.join(map(self.inline, value))}]"
        return self.value(value)

    def table(self, path: list[str], data: dict[str, Any]) -> list[str]:
        """Lines: first what is a value or written inline, then tables and rows."""
        first, later = [], []
        for key, value in data.items():
            here = [*path, self.key(key)]
            rows = isinstance(value, list) and value and all(isinstance(row, dict) for row in value)
            style = self.pick("inline", "header", "dotted")
            if isinstance(value, dict) and value and style == "header":
                later += [
                    "",
                    self.comment(),
                    f"[{self.pick('', ' ')}{'.'.join(here)}{self.pick('', ' ')}] {self.comment()}",
                ]
                later += self.table(here, value)
            elif isinstance(value, dict) and value and style == "dotted":
                for inner, one in value.items():
                    first.append(
                        f"{here[-1]}{self.pick('.', ' . ')}{self.key(inner)} = {self.value(one)} {self.comment()}"
                    )
            elif rows and style == "header":
                for row in value:
                    later += [self.comment(), f"[[{self.pick('', ' ')}{'.'.join(here)}]] {self.comment()}"]
                    later += self.table(here, row)
            else:
                first.append(f"{here[-1]} = {self.value(value)} {self.comment()}")
        return [*first, *later]


@st.composite
def files(draw: st.DrawFn) -> tuple[str, list[str]]:
    emitter = Emitter(draw)
    lines = emitter.table([], draw(st.dictionaries(KEYS, VALUES, max_size=5)))
    return "\n".join(lines) + draw(st.sampled_from(["", "\n", "\n# end\n"])), emitter.comments


MEASURED = st.dictionaries(
    st.sampled_from(["baud", "rate_hz", "a b"]),
    st.integers(0, 9) | st.just('it\'s "x" \\') | st.just((1.5, -2.0)),
    min_size=1,
)


@settings(max_examples=300)
@given(file=files(), table=st.sampled_from(["kinect", "network", "network.arm", "new.table"]), values=MEASURED)
def test_in_any_legal_file_the_other_values_and_all_comments_stay(
    file: tuple[str, list[str]], table: str, values: dict[str, Any]
) -> None:
    text, comments = file
    wanted = tomllib.loads(text)
    place: Any = wanted
    for key in table.split("."):
        if not isinstance(place, dict):
            break
        place = place.setdefault(key, {})
    if not isinstance(place, dict):
        with pytest.raises(ConfigError, match="is no table"):
            with_values(text, table, values)
        return
    replaced = [place.get(key) for key in values]
    place.update({key: list(value) if isinstance(value, tuple) else value for key, value in values.items()})
    changed = with_values(text, table, values)
    assert repr(tomllib.loads(changed)) == repr(wanted) or tomllib.loads(changed) == wanted
    if not any(isinstance(old, list | dict) for old in replaced):
        assert all(comment in changed for comment in comments)


@settings(max_examples=200)
@given(file=files(), name=st.sampled_from(["elbow", "a b", '"']), values=MEASURED)
def test_in_any_legal_file_a_row_is_changed_or_added_by_its_name(
    file: tuple[str, list[str]], name: str, values: dict[str, Any]
) -> None:
    text, comments = file
    wanted = tomllib.loads(text)
    rows = wanted.setdefault("joint", [])
    if not isinstance(rows, list) or not all(isinstance(row, dict) for row in rows):
        with pytest.raises(ConfigError, match="joint is no list of tables"):
            with_values(text, "joint", values, name)
        return
    row = next((row for row in rows if row.get("name") == name), None)
    if row is None:
        rows.append(row := {"name": name})
    replaced = [row.get(key) for key in values]
    row.update({key: list(value) if isinstance(value, tuple) else value for key, value in values.items()})
    changed = with_values(text, "joint", values, name)
    assert tomllib.loads(changed) == wanted
    if not any(isinstance(old, list | dict) for old in replaced):
        assert all(comment in changed for comment in comments)
