"""`cocoro site`: the plan of several machines, what it says, and who may do what by it."""

from __future__ import annotations

import sys
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from apps.cli import exits
from apps.cli.options import JsonOption
from apps.cli.output import complain, print_json
from apps.cli.terminal import Column, print_table
from cocoro.errors import ConfigError
from deploy.site import place

if TYPE_CHECKING:
    from deploy.site.plan import Site

app = typer.Typer()
site = typer.Typer(no_args_is_help=True, help="Check the plan of several machines; show it, its steps and its rules.")
app.add_typer(site, name="site")

PlanArgument = Annotated[
    Path | None,
    typer.Argument(metavar="[FILE]", help="The site's plan or folder; by default $COCORO_SITE, or this folder's."),
]
SHORT = {"puts": "put", "hears": "hear", "asks": "ask", "answers": "answer", "shows": "show", "watches": "watch"}
"""How the table of rules names what somebody may do."""
KIB = 1024


@site.command()
def check(file: PlanArgument = None, json: JsonOption = False) -> None:
    """Read a plan and its certificates, and name what contradicts or is missing. Exit code 1 when something is."""
    found = _read(file)
    missing = problems(found)
    if json:
        print_json({"site": found.name, "file": str(found.path), "well": not missing, "problems": missing})
    else:
        print(f"{found.path}: site {found.name}: {_counted(found)}")
        for problem in missing:
            complain(problem)
        if not missing:
            print("well: every process has a host, every host a way to the others, everybody a certificate")
    sys.exit(exits.FAILED if missing else exits.DONE)


@site.command()
def show(file: PlanArgument = None, json: JsonOption = False) -> None:
    """Show a plan: hosts with their processes and links, persons with their roles."""
    found = _read(file)
    if json:
        print_json(as_data(found))
        return
    print_table(
        ("host", "role", "robot", "processes", "listens at", "connects to"),
        [
            (name, row.role, row.robot, " ".join(row.processes), " ".join(row.listen), " ".join(found.connects(name)))
            for name, row in found.hosts.items()
        ],
    )
    if found.persons:
        print()
        print_table(
            ("person", "role", "robots"),
            [(name, row.role, " ".join(found.robots_of(name))) for name, row in found.persons.items()],
        )


@site.command()
def plan(file: PlanArgument = None, json: JsonOption = False) -> None:
    """Print the steps that bring a plan to life: certificates, what to copy where, what to start."""
    steps = steps_of(_read(file))
    if json:
        print_json([{"where": where, "command": command, "why": why} for where, command, why in steps])
    else:
        print_table(("where", "command", Column("why", text=True)), steps)


@site.command()
def rules(
    file: PlanArgument = None,
    robot: Annotated[str | None, typer.Option(metavar="NAME", help="The robot, where the site has several.")] = None,
    host: Annotated[
        str | None, typer.Option(metavar="NAME", help="Print what this host's gateway gives to zenoh, as JSON.")
    ] = None,
    json: JsonOption = False,
) -> None:
    """Who may do what: one row for each key, one column for each host and person; an empty cell is a refusal."""
    from deploy.site.matrix import matrix

    found = _read(file)
    if host is not None:
        from deploy.site.rules import compiled

        print_json(compiled(found, host, _names(found)))
        return
    if robot is None:
        robot = _only_robot(found)
    elif robot not in found.profiles:
        raise ConfigError(f"site {found.name} has no robot {robot!r}: {', '.join(found.profiles)}")
    rows = matrix(found, robot)
    if json:
        print_json([row._asdict() for row in rows])
        return
    names = list(rows[0].may)
    print_table(
        ("key", *names, "at most", "a second"),
        [
            (
                f"{robot}/{row.key}",
                *(" ".join(SHORT[verb] for verb in row.may[name]) for name in names),
                "" if row.max_bytes is None else _size(row.max_bytes),
                "" if row.max_hz is None else f"{row.max_hz:g}",
            )
            for row in rows
        ],
    )


# --- what they print ------------------------------------------------------------------------------


def problems(found: Site) -> list[str]:
    """What is missing before the site can run, beyond the plan itself: certificates, and what they say."""
    from deploy.site import admitted

    try:
        known = admitted.read(found.folder)
    except ConfigError as error:
        return [str(error)]
    now = datetime.now(UTC)
    missing = []
    for name in found.principals:
        role = found.role(name)
        if name not in known.names:
            missing.append(f"{name} has no certificate: cocoro pki issue {role} {name}")
            continue
        newest = known.newest(name)
        if newest.role != role:
            missing.append(
                f"{name} is {role} by the plan and {newest.role} by its certificate: revoke it, issue it anew"
            )
        if not newest.is_valid(now):
            missing.append(f"{name}'s certificate is revoked or has expired: cocoro pki renew {name}")
        missing += [
            f"{name} listens at {at}, which its certificate does not name: cocoro pki renew {name} --address {at}"
            for at in found.addresses(name)
            if at not in newest.addresses
        ]
    missing += [
        f"{name} has a certificate, and is not in the plan" for name in known.names if name not in found.principals
    ]
    return missing


def steps_of(found: Site) -> list[tuple[str, str, str]]:
    """The steps to a running site: where, what to run there, and why."""
    steps = [("authority", "cocoro pki init", "once: makes the key that signs all certificates; it stays here")]
    for name in found.principals:
        at = [f"--address {address}" for address in found.addresses(name)]
        command = " ".join(("cocoro pki issue", found.role(name), name, *at))
        steps.append(("authority", command, f"writes {place.CREDENTIALS}/{name}"))
    files = f"{place.PLAN} {place.ADMITTED}"
    steps += [
        (name, f"# copy {files} {place.CREDENTIALS}/{name} here", "its own credentials, and nobody else's")
        for name in found.principals
    ]
    steps += [
        (name, f"cocoro up --site DIR --host {name}", f"starts {', '.join(row.processes)} and the gateway")
        for name, row in found.hosts.items()
    ]
    steps += [
        (name, f"cocoro status --site {name}@DIR", f"as every command; {name} is {row.role}")
        for name, row in found.persons.items()
    ]
    return steps


def as_data(found: Site) -> dict[str, Any]:
    """A plan as data, with what it leaves out filled in."""
    return {
        "site": found.name,
        "robots": {robot: {"profile": profile.name} for robot, profile in found.profiles.items()},
        "hosts": {
            name: {
                "role": row.role,
                "robot": row.robot,
                "processes": row.processes,
                "listen": row.listen,
                "connect": found.connects(name),
            }
            for name, row in found.hosts.items()
        },
        "persons": {name: {"role": row.role, "robots": found.robots_of(name)} for name, row in found.persons.items()},
    }


def _read(file: Path | None) -> Site:
    from deploy.site import plan as plans

    return plans.read(place.folder() if file is None else file)


def _only_robot(found: Site) -> str:
    if len(found.profiles) > 1:
        raise ConfigError(f"site {found.name} has several robots; choose one: --robot {' or '.join(found.profiles)}")
    return next(iter(found.profiles))


def _names(found: Site) -> dict[str, tuple[str, ...]]:
    from deploy.site import admitted

    known = admitted.read(found.folder)
    now = datetime.now(UTC)
    return {name: known.common_names(name, now) for name in known.names}


def _counted(found: Site) -> str:
    counts = ((len(found.hosts), "host"), (len(found.profiles), "robot"), (len(found.persons), "person"))
    return ", ".join(f"{count} {what}{'' if count == 1 else 's'}" for count, what in counts)


def _size(size: int) -> str:
    return f"{size // KIB} KiB" if size < KIB * KIB else f"{size // KIB // KIB} MiB"
