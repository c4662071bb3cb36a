"""`cocoro cockpit`: who is let into the cockpit from other machines by a code."""

from __future__ import annotations

from typing import Annotated, Any

import typer

from apps.cli import completions
from apps.cli.link import find
from apps.cli.options import JsonOption, RobotChoice, RobotOption
from apps.cli.output import print_json, tell
from apps.cli.terminal import Column, print_table
from cocoro import private
from cocoro.errors import RefusedError
from deploy.rundir import START, RunDir
from services.cockpit.access_people import (
    ADDRESS,
    ADDRESS_BYTES,
    CODE_S,
    SESSION_S,
    Listed,
    People,
    folder_of,
    named,
    role_of,
    spaced,
)
from services.cockpit.component import COCKPIT

app = typer.Typer()
cockpit = typer.Typer(no_args_is_help=True, help="Let persons into the cockpit from other machines; list them, end it.")
app.add_typer(cockpit, name="cockpit")


@cockpit.command()
def invite(
    role: Annotated[
        str,
        typer.Argument(
            metavar="ROLE",
            autocompletion=completions.of("viewer", "operator"),
            help="viewer: looks and stops; operator: does everything.",
        ),
    ],
    name: Annotated[str, typer.Option("--name", metavar="NAME", help="Who it is for, in lists and logs.")] = "",
    robot: RobotOption = None,
    json: JsonOption = False,
) -> None:
    """Print a code for one login from another machine, within ten minutes."""
    asked = role_of(role), named(name) if name else ""
    run_dir = find(RobotChoice(robot))
    url = _address(run_dir)
    code = spaced(_people(run_dir).invite(*asked))
    data = {"code": code, "role": role, "name": name, "url": url, "valid_s": CODE_S, "session_s": SESSION_S}
    hours = f"{SESSION_S / 3600:.0f} hours"
    text = f"{code}\nOpen {url} within {CODE_S / 60:.0f} minutes and give this code there: once, as {role}, for {hours}"
    tell(json, data, text)


@cockpit.command("list")
def list_people(robot: RobotOption = None, json: JsonOption = False) -> None:
    """The open codes and the sessions: who, in which role, from where, and for how much longer."""
    rows = _people(find(RobotChoice(robot))).listed()
    if json:
        print_json([_row(row) for row in rows])
    elif not rows:
        print("no codes and no sessions: `cocoro cockpit invite ROLE` makes a code")
    else:
        columns = (
            Column("name"), Column("role"), Column("what"), Column("key"), Column("ends in", right=True),
            Column("from", 1),
        )  # fmt: skip
        cells = [(row.name, row.role, row.kind, row.key, _span(row.left_s), row.address) for row in rows]
        print_table(columns, cells)


@cockpit.command()
def end(
    who: Annotated[str, typer.Argument(metavar="WHO", help="A name or a key of `cocoro cockpit list`, or all.")],
    robot: RobotOption = None,
    json: JsonOption = False,
) -> None:
    """End codes and sessions. Open pages of a session that has ended are closed within a second."""
    ended = _people(find(RobotChoice(robot))).end(who)
    text = f"ended: {', '.join(f'{row.name} ({row.kind})' for row in ended) or 'there was nothing to end'}"
    tell(json, {"ended": [_row(row) for row in ended]}, text)


def _people(run_dir: RunDir) -> People:
    return People(folder_of(run_dir.robot))


def _address(run_dir: RunDir) -> str:
    """Where others open the page. Raises RefusedError where they cannot."""
    if run_dir.claimant(COCKPIT.name) is None:
        raise RefusedError(f"{run_dir.robot} has no cockpit running: {START}")
    try:
        return private.read(folder_of(run_dir.robot) / ADDRESS, ADDRESS_BYTES).decode("ascii", "replace")
    except FileNotFoundError:
        raise RefusedError(
            f"the cockpit of {run_dir.robot} is open to this machine alone, where its user needs no code: for others "
            f"give `[service.cockpit]` of its profile `host` and `credentials`"
        ) from None


def _row(row: Listed) -> dict[str, Any]:
    return row._asdict() | {"left_s": round(row.left_s)}


def _span(seconds: float) -> str:
    minutes = int(seconds // 60)
    return f"{minutes // 60} h {minutes % 60:02} min" if minutes >= 60 else f"{minutes} min"
