"""Pages that want what they may not, send what is no message, or ask for files that are none: on the whole cockpit."""

from __future__ import annotations

from pathlib import Path
from typing import Any, get_args
from urllib.parse import quote

import pytest
from cockpit_access_rig import Fixed, ask, head
from cockpit_rig import CockpitRig, cockpit

from cocoro.messages import CancelRequest, DriveReply, DriveRequest, EstopReply, TaskReply, TaskRequest
from cocoro.testing import in_virtual_time
from cocoro.topics import CANCEL, DRIVE, RESET, RUN
from services.cockpit import orders
from services.cockpit.access import Visitor
from services.cockpit.access_passage import Passage

OPERATING: dict[str, dict[str, Any]] = {
    "run": {"id": 1, "task": {"task": "park"}},
    "cancel": {"id": 2},
    "reset": {"id": 3},
    "begin-drive": {"id": 4},
    "end-drive": {"id": 5},
    "drive": {"tick": 1, "motion": {"speed_mps": 0.2}},
}
"""Messages that only an operator may send."""
LOOKING = {"seen", "log", "pictures", "what", "seek", "pause", "speed"}
STOPPING = {"stop"}


def by_do() -> dict[str, Any]:
    """Every message that a page may send, by its `do`."""
    kinds = {*get_args(orders.LiveOrder), *get_args(orders.PlayOrder)}
    return {kind.__struct_config__.tag: kind for kind in kinds}


def test_every_message_is_for_somebody() -> None:
    """A new message must be put into one of the tables here: who may send it is a decision."""
    rights = {do: orders.RIGHTS.get(kind, "look") for do, kind in by_do().items()}
    assert rights == {
        **dict.fromkeys(OPERATING, "operate"), **dict.fromkeys(LOOKING, "look"), **dict.fromkeys(STOPPING, "stop")
    }  # fmt: skip


def heard(rig: CockpitRig) -> list[str]:
    """Has a robot answer, and returns what it is asked, as it comes."""
    asked: list[str] = []

    async def run(question: TaskRequest) -> TaskReply:
        asked.append("run")
        return TaskReply(task_id="task-1", accepted=True)

    async def cancel(_: CancelRequest) -> TaskReply:
        asked.append("cancel")
        return TaskReply(task_id="task-1", accepted=True)

    async def drive(question: DriveRequest) -> DriveReply:
        asked.append("drive")
        return DriveReply(accepted=True, tick=1)

    async def reset(_: object) -> EstopReply:
        asked.append("reset")
        return EstopReply(service="base", latch="released")

    rig.service.serve(RUN, run)
    rig.service.serve(CANCEL, cancel)
    rig.service.serve(DRIVE, drive)
    rig.service.serve(RESET.of("base"), reset)
    rig.service.others_live("base")
    return asked


@pytest.mark.parametrize("do", OPERATING)
@in_virtual_time
async def test_a_viewers_page_operates_nothing(do: str, short_path: Path) -> None:
    async with cockpit(short_path, "viewer") as rig:
        asked = heard(rig)
        await rig.service.settle()
        async with rig.page() as page:
            if "id" in OPERATING[do]:
                reply = await page.asks(do, **{k: v for k, v in OPERATING[do].items() if k != "id"})
                assert not reply["ok"]
                assert "operator" in reply["text"]
            else:
                page.say(do, **OPERATING[do])
            await rig.service.advance(1.0)
        assert asked == []


MALFORMED = (
    "", "{", "null", "[]", '"stop"', "0", "{}", '{"do":null}', '{"do":"shutdown"}', '{"do":["stop"]}', '{"do":"run"}',
    '{"do":"run","id":1,"task":[]}', '{"do":"run","id":1,"task":{},"more":1}', '{"do":"drive","tick":-1,"motion":{}}',
    '{"do":"drive","tick":1,"motion":{"speed_mps":NaN}}', '{"do":"drive","tick":1,"motion":{"speed_mps":1e999}}',
    '{"do":"drive","tick":1,"motion":{"grip":"crush"}}', '{"do":"drive","tick":1.5,"motion":{}}', '{"do":"cancel"}',
    '{"do":"cancel","id":{}}', '{"do":"cancel","id":"' + "a" * 65 + '"}', '{"do":"seen","stamp_ns":"now"}',
    '{"do":"what","id":1,"map":[1]}', '{"do":"what","id":1,"map":[1e999,0]}', '{"do":"log","on":"yes"}',
    '{"do":"seek","at_s":1}', "[" * 30_000, '{"do":"run","id":1,"task":' + '{"a":' * 9000 + "1" + "}" * 9001,
    '{"do":"reset","id":1,"id2":2}', "\x00", "\ud83d", '{"do":"stop","id":1,"force":true}',
)  # fmt: skip


@pytest.mark.parametrize("text", MALFORMED, ids=range(len(MALFORMED)))
@in_virtual_time
async def test_what_is_no_message_ends_its_page_with_a_reason_and_moves_nothing(text: str, short_path: Path) -> None:
    async with cockpit(short_path) as rig:
        asked = heard(rig)
        async with rig.page() as page:
            page.say_raw(text)
            await rig.service.advance(0.5)
            assert page.closed is not None
            code, reason = page.closed
            assert code == 1008
            assert reason
            assert len(reason.encode()) <= 123
        assert asked == []
        async with rig.page() as other:
            assert (await other.asks("what", map=[1.0, 0.0]))["text"]


SECRET = b"nobody may read this"
NAMES = (
    "../secret.mcap", "..%2fsecret.mcap", "..", ".", "", "secret", "/etc/passwd", "....//secret.mcap",
    "..\\secret.mcap", "%2e%2e/secret.mcap", "link.mcap", "captures/../../secret.mcap", "\0", "a" * 300, "~",
    "*", "latest/../../secret", "file:///etc/passwd", "folder.mcap", ".hidden.mcap", "one.mcap/../../secret.mcap",
)  # fmt: skip
WAYS = (("GET", "/captures/{}/file"), ("DELETE", "/captures/{}"), ("POST", "/captures/{}/pin"))


@pytest.mark.parametrize("gated", [True, False], ids=["through the gate", "without the gate"])
@pytest.mark.parametrize("name", NAMES, ids=range(len(NAMES)))
@in_virtual_time
async def test_no_name_of_a_capture_leads_elsewhere(name: str, gated: bool, short_path: Path) -> None:
    folder, secret = short_path / "captures", short_path / "secret.mcap"
    secret.write_bytes(SECRET)
    (folder / "folder.mcap").mkdir(parents=True)
    (folder / "link.mcap").symlink_to(secret)
    (folder / ".hidden.mcap").write_bytes(SECRET)
    async with cockpit(folder) as rig:
        gate = Fixed()
        gate.visitor = Visitor("owner", "operator")
        app = Passage(gate, rig.app.asgi) if gated else rig.app.asgi
        for method, path in WAYS:
            for written in (quote(name, safe="%"), quote(name, safe="/%")):
                scope = head(method, path.format(written), [("Origin", "http://127.0.0.1:8770")])
                scope["path"], scope["root_path"] = path.format(name), ""
                answer = await ask(app, scope)
                assert answer.status in (303, 307, 400, 403, 404, 405, 409), (method, answer)
                assert SECRET not in answer.body
    assert secret.read_bytes() == SECRET
    assert (folder / "link.mcap").is_symlink()
    assert (folder / ".hidden.mcap").exists()
