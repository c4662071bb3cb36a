"""`cocoro objects learn` as a person uses it, and the catalogue's file that it writes."""

from __future__ import annotations

import asyncio
import json
import sys
from pathlib import Path

import cv2
import msgspec
import numpy as np
import pytest
import tomlkit
from perception_scenes import Canvas, Scene, Thing, facing

from apps.cli.learn_object import size_of
from apps.cli.main import main
from apps.cli.toml_files import save, with_object
from apps.pictures import colour_of
from apps.rehearsal.rehearse import rehearse
from apps.rehearsal.request import RehearsalRequest
from cocoro.bus.endpoints import default
from cocoro.bus.zenoh import ZenohBus
from cocoro.clock import RealClock
from cocoro.component import load
from cocoro.errors import ConfigError
from cocoro.messages import ServoState
from cocoro.node import Node
from cocoro.objects import Catalogue, LabBox, ObjectSpec, own_text
from cocoro.robot import Robot
from cocoro.topics import ARM_STATE, FRAME
from deploy import profiles
from deploy.processes import named
from services.executive.tasks import FetchTask
from sim.scene import Light

TEAL = (20, 150, 140)


@pytest.fixture(autouse=True)
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder of one's own, no robot, nobody at the keyboard."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COCORO_RUN_DIR", str(tmp_path / "run"))
    monkeypatch.setattr(sys.stdin, "isatty", lambda: False, raising=False)
    return tmp_path


def canvas() -> Canvas:
    """A teal thing of 6 x 10 cm, 1 m away."""
    painted = Canvas(320, 240)
    painted.rectangle("red_can", (160.0, 120.0), 1.0, (0.06, 0.10))
    painted.colour[(painted.colour != 128).any(axis=-1)] = TEAL
    return painted


@pytest.fixture
def photo(here: Path) -> str:
    cv2.imwrite("photo.png", cv2.cvtColor(canvas().colour, cv2.COLOR_RGB2BGR))
    return "photo.png"


# --- the command ----------------------------------------------------------------------------------


def test_what_it_would_match_is_shown_and_nothing_is_saved_without_yes(
    photo: str, here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["objects", "learn", "cup", "--from", photo, "--size", "0.06x0.1"]) == 3  # nobody is there to ask
    out, err = capsys.readouterr()
    assert "cup: cylinder, 6.0 x 6.0 x 10.0 cm (as given)" in out
    assert "the robot   cup (no depth)" in out  # what perception itself makes of the picture
    assert "nothing is saved" in err
    assert "--yes" in err
    assert not (here / "objects.toml").exists()
    drawn = cv2.imread("cup.png")
    assert drawn is not None
    assert drawn.shape == (240, 320, 3)
    inside = drawn[129:132, 154:158].reshape(-1, 3).mean(axis=0)  # blue, green, red: tinted green
    assert inside[1] > 180


def test_with_yes_it_is_saved_beside_all_that_was_known_and_the_robots_processes_take_it(
    photo: str, here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["objects", "learn", "cup", "--from", photo, "--distance", "1", "--yes"]) == 0
    assert "saved in objects.toml, which has 7 objects now" in (out := capsys.readouterr().out)
    assert "--objects objects.toml" in out
    written = Catalogue.load(here / "objects.toml")
    assert written.labels == (*Catalogue.load().labels, "cup")
    assert written["cup"].size_m == pytest.approx((0.06, 0.06, 0.10), abs=0.004)

    profile = profiles.read("sim", [f'objects="{here}/objects.toml"'])
    for process in ("perception", "executive", "sim"):  # the simulator draws it in the learned colour
        config = profile.config(process, load(named(process)).config)
        assert config.objects == f"{here}/objects.toml"
    assert profile.config("planning", load(named("planning")).config)  # has no such field, and is not told


def test_the_figures_are_data_for_scripts(photo: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert (
        main(["objects", "learn", "cup", "--from", photo, "--size", "0.06x0.1", "--at", "160,120", "--json", "--no"])
        == 0
    )
    report = json.loads(capsys.readouterr().out)
    assert report["object"]["label"] == "cup"
    assert report["saved"] is False
    assert report["matched_share"] > 0.8
    assert report["seen"] == ["cup (no depth)"]


def test_what_is_known_is_only_replaced_or_added_to_when_that_is_said(
    photo: str, here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    learn = ["objects", "learn", "cup", "--from", photo, "--size", "0.06x0.1", "--yes"]
    assert main(learn) == 0
    assert main(learn) == 2
    assert "cup is known already in objects.toml: --replace" in capsys.readouterr().err
    before = Catalogue.load(here / "objects.toml")["cup"]

    other = canvas()
    other.colour[(other.colour == TEAL).all(axis=-1)] = (140, 30, 150)
    cv2.imwrite("purple.png", cv2.cvtColor(other.colour, cv2.COLOR_RGB2BGR))
    assert main([*learn[:3], "--from", "purple.png", "--size", "0.08x0.1", "--yes", "--add"]) == 0
    both = Catalogue.load(here / "objects.toml")["cup"]
    assert set(before.lab) < set(both.lab)
    assert both.radius_m == before.radius_m
    assert main([*learn[:3], "--from", "purple.png", "--size", "0.08x0.1", "--yes", "--replace"]) == 0
    only = Catalogue.load(here / "objects.toml")["cup"]
    assert not set(before.lab) & set(only.lab)
    assert only.radius_m == 0.04


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (["Cup", "--from", "photo.png"], "is not a valid label"),
        (["cup", "--from", "nowhere.png"], "there is no picture nowhere.png"),
        (["cup", "--from", "words.png"], "is not a readable picture"),
        (["cup", "--from", "photo.png"], "give --size"),
        (["cup", "--from", "photo.png", "--size", "6cm"], "write it in metres"),
        (["cup", "--from", "photo.png", "--size", "60"], "it is in metres"),
        (["cup", "--from", "photo.png", "--size", "0x1"], "write it in metres"),
        (["cup", "--from", "photo.png", "--at", "middle"], "write it as U,V"),
        (["cup", "--from", "photo.png", "--box", "1,2,3"], "LEFT,TOP,RIGHT,BOTTOM"),
        (["cup", "--from", "photo.png", "--at", "1,2", "--box", "1,2,3,4"], "give one of them"),
        (["cup", "--from", "photo.png", "--shape", "cone"], "cylinder, sphere and box"),
        (["cup", "--from", "photo.png", "--picture", "cup.jpg"], "name must end with .png"),
        (["cup", "--from", "photo.png", "--size", "0.1", "--catalogue", "words.png"], "words.png"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_a_mistake_gets_one_line_and_exit_code_2(
    photo: str, capsys: pytest.CaptureFixture[str], arguments: list[str], complaint: str
) -> None:
    Path("words.png").write_text("no picture, no catalogue")
    assert main(["objects", "learn", *arguments]) == 2
    err = capsys.readouterr().err
    assert complaint in err
    assert len(err.splitlines()) == 1
    assert not Path("objects.toml").exists()


def test_without_a_robot_a_live_view_is_not_to_be_had(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["objects", "learn", "cup"]) == 4
    assert "cocoro up sim" in capsys.readouterr().err


def test_up_refuses_a_bad_file_of_objects_at_once(capsys: pytest.CaptureFixture[str]) -> None:
    Path("bad.toml").write_text("[[object]]\nlabel = 'x'\n")
    assert main(["up", "sim", "--objects", "bad.toml"]) == 2
    assert "bad.toml" in capsys.readouterr().err


def test_sizes_are_one_to_three_lengths() -> None:
    assert [size_of(text) for text in ("0.08", ".066x.12", "0.1x0.06x0.2")] == [
        (0.08,), (0.066, 0.12), (0.1, 0.06, 0.2)
    ]  # fmt: skip


@pytest.mark.process
@pytest.mark.zenoh
def test_the_live_view_brings_depth_and_the_heads_angles(
    short_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("COCORO_RUN_DIR", str(short_path))
    none = (0.0, 0.0)

    async def see(camera: Node, arm: Node) -> None:
        async for now_ns in camera.every(30.0):
            head = ServoState(joints=("neck_pan", "neck_tilt"), position_rad=none, speed_radps=none, load=none)
            arm.publish(ARM_STATE, head)
            camera.publish(FRAME, canvas().frame(now_ns - 20_000_000))

    async def scenario() -> int:
        async with (
            await ZenohBus.open(default("calliope", "robot")) as bus,
            Node("kinect", bus, RealClock(), Robot.load()) as camera,
            Node("arm", bus, RealClock(), Robot.load()) as arm,
        ):
            camera.spawn(see(camera, arm))
            command = await asyncio.create_subprocess_exec(
                sys.executable, "-m", "apps.cli.main", "objects", "learn", "cup", "--yes",
                stdin=asyncio.subprocess.DEVNULL, stdout=asyncio.subprocess.PIPE, stderr=asyncio.subprocess.STDOUT,
            )  # fmt: skip
            out, _ = await command.communicate()
            print(out.decode())
            return command.returncode or 0

    assert asyncio.run(scenario()) == 0
    out = capsys.readouterr().out
    assert "cup: cylinder, 6." in out
    assert "the robot   cup 1." in out  # found by perception, and localised
    cup = Catalogue.load(Path("objects.toml"))["cup"]
    assert cup.size_m == pytest.approx((0.06, 0.06, 0.10), abs=0.006)


@pytest.mark.sim
def test_what_was_learnt_from_one_look_is_fetched(here: Path) -> None:
    rgb = (0.95, 0.45, 0.05)
    thing = Thing("orange_can", "cylinder", (0.03, 0.11), rgb, (1.1, 0.1, 0.055))
    pan, tilt = facing(thing)
    with Scene([thing], sensors="real", light=Light(temperature_k=6200)) as scene:
        cv2.imwrite("photo.png", cv2.cvtColor(colour_of(scene.frame(pan, tilt)), cv2.COLOR_RGB2BGR))
    arguments = ["orange_can", "--from", "photo.png", "--size", "0.06x0.11", "--mass", "0.2", "--yes"]
    assert main(["objects", "learn", *arguments]) == 0

    Path("scene.toml").write_text(
        """
        name = "one can"
        [[object]]
        label = "orange_can"
        shape = "cylinder"
        radius_m = 0.03
        height_m = 0.11
        position_m = [1.0, -0.2]
        [light]
        temperature_k = 4900
        """
    )
    rehearsal = RehearsalRequest(
        task=FetchTask(label="orange_can"), scene="scene.toml", sensors="real", objects="objects.toml",
        width=320, height=240, frame_rate_hz=15.0,
    )  # fmt: skip
    result = rehearse(rehearsal)
    assert result["outcome"] == "done"
    assert result["truth"]["held"]


# --- the file -------------------------------------------------------------------------------------

CUP = ObjectSpec(
    label="cup", shape="cylinder", radius_m=0.031, height_m=0.1, mass_kg=0.15, graspable=True, rgb=(0.1, 0.6, 0.5),
    lab=(LabBox((10, -30, -5), (60, -10, 5)),), lab_by_shape=(LabBox((5, -12, -5.5), (10, -4, 5)),),
)  # fmt: skip
BOX = msgspec.structs.replace(CUP, shape="box", radius_m=None, height_m=None, box_m=(0.1, 0.2, 0.3))


@pytest.mark.parametrize("known", [CUP, BOX, *Catalogue.load()], ids=lambda known: f"{known.label} {known.shape}")
def test_an_objects_table_says_what_the_object_is(known: ObjectSpec) -> None:
    assert tuple(Catalogue.from_text(with_object("", known), "test")) == (known,)


def test_an_object_is_put_behind_all_others_and_nothing_else_changes() -> None:
    text = with_object(own_text(), CUP)
    assert text.startswith(own_text().rstrip())
    assert Catalogue.from_text(text, "test")["cup"] == CUP


def test_an_object_takes_the_place_of_its_own_older_table_and_peoples_comments_stay() -> None:
    before = own_text()
    red = msgspec.structs.replace(CUP, label="blue_can")
    text = with_object(before, red)
    catalogue = Catalogue.from_text(text, "test")
    assert catalogue.labels == Catalogue.load().labels
    assert catalogue["blue_can"] == red
    for line in before.splitlines():
        if line.startswith("#"):
            assert line in text
    unchanged = with_object(before, catalogue["red_can"])
    assert unchanged == before, "a value that is the same is not written anew"
    assert [known for known in catalogue if known.label != "blue_can"] == [
        known for known in Catalogue.load() if known.label != "blue_can"
    ]


@pytest.mark.parametrize(
    "text",
    [
        "# mine\n[[ object ]] # one\n{row}\n\n# end\n",
        "object = [ # mine, one\n  {{ {inline} }}, # end\n]\n",
        "# mine one\n'object' = [{{{inline}}}] # end\n",
    ],
)
def test_an_object_is_added_to_and_replaced_in_any_form_of_list(text: str) -> None:
    mug = tomlkit.parse(with_object("", msgspec.structs.replace(CUP, label="mug")))["object"][0]
    rows = [f"{key} = {tomlkit.item(value).as_string()}" for key, value in mug.items()]
    text = text.format(row="\n".join(rows), inline=", ".join(rows))
    for known in (CUP, msgspec.structs.replace(CUP, label="mug", mass_kg=0.3, lab_by_shape=())):
        changed = with_object(text, known)
        catalogue = Catalogue.from_text(changed, "test")
        assert catalogue[known.label] == known
        assert catalogue.labels == tuple(dict.fromkeys(("mug", known.label)))
        assert all(word in changed for word in ("mine", "one", "# end"))


def test_a_catalogue_whose_objects_are_no_list_of_tables_is_refused(here: Path) -> None:
    (here / "mine.toml").write_text("object = 3\n")
    with pytest.raises(ConfigError, match=r"mine\.toml: object is no list of tables"):
        save(here / "mine.toml", CUP)


def test_a_file_that_would_be_no_catalogue_is_left_as_it_was(here: Path) -> None:
    path = here / "mine.toml"
    path.write_text("[[object]]\nlabel = 'half'\n")
    with pytest.raises(ConfigError, match=r"mine\.toml"):
        save(path, CUP)
    assert path.read_text() == "[[object]]\nlabel = 'half'\n"
    assert [file.name for file in here.iterdir()] == ["mine.toml"]


def test_a_place_that_cannot_be_written_to_is_named(here: Path) -> None:
    (here / "file").touch()
    with pytest.raises(ConfigError, match=r"file/objects\.toml.*Not a directory"):
        save(here / "file" / "objects.toml", CUP)


def test_a_new_file_begins_with_what_the_project_knows(here: Path) -> None:
    catalogue = save(here / "new" / "objects.toml", CUP)
    assert catalogue.labels == (*Catalogue.load().labels, "cup")
    assert np.array([known.graspable for known in catalogue]).sum() == 5
