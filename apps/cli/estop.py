"""`cocoro estop`, in short `stop`: the emergency stop by the stop path, then by the mesh where the path left something.

The stop path is used before anything else is imported or read, so a stop takes no longer than Python takes to start.
"""

from __future__ import annotations

import os
import sys
import time
from typing import TextIO

from apps.cli import exits, output
from apps.cli.output import recent_complaints
from apps.cli.stop_result import StopResult
from cocoro.stop.asking import STOPPABLE, Asking, Point, movers_first

EXECUTIVE = "executive"
"""The executive ends its task at a stop. It moves nothing itself, so the command does not wait for its answer."""
ACKNOWLEDGE_S = 0.6
"""Longest wait for acknowledgements on the stop path; then the mesh is tried, too."""
SITE = "COCORO_SITE"
"""Environment variable with the site whose robots are stopped where none is on this machine."""
KEPT_S = 0.3
"""Longest wait after that for the news that the latches are on the disk."""


def main(command: str, arguments: list[str]) -> int:
    robot, site, as_json = None, None, False
    if arguments:
        import argparse

        parser = argparse.ArgumentParser(
            prog=f"cocoro {command}",
            description="Latch the emergency stop: wheels, arm and hand hold still until `cocoro reset`. "
            "Without --robot and --site every robot on this machine is stopped, other users' robots, too.",
            epilog="Exit code 0 when every service that moves something has acknowledged, 1 when one has not "
            "(it is named), 4 when no robot is there.",
        )
        parser.add_argument("--robot", metavar="NAME")
        parser.add_argument(
            "--site",
            metavar="[NAME@]DIR",
            help="stop the robots of the site in this folder, as NAME",
        )
        parser.add_argument("--json", action="store_true", help="print one JSON object for each robot")
        try:
            options = parser.parse_args(arguments)
        except SystemExit as end:
            recent_complaints.append(f"wrong arguments: see `cocoro {command} --help`")  # argparse has printed more
            return end.code if isinstance(end.code, int) else exits.USAGE
        robot, site, as_json = options.robot, options.site, options.json
    stops, troubles = by_path(robot)
    if site is None and not stops:
        site = os.environ.get(SITE) or None
    started_s = _process_start_s()
    code = exits.DONE
    try:
        left_open = None if site is not None or not stops else _left_open(robot, stops)
        if left_open is None or left_open:
            stops, troubles, code = _by_mesh_too(robot, site, left_open, started_s, stops, troubles)
    except Exception as error:  # whatever it is, the stops so far must be reported
        troubles.append(f"the mesh could not be asked: {type(error).__name__}: {error}")
        code = exits.FAILED
    # The operator's own robots come last, where they are seen.
    for stop in sorted(stops, key=lambda stop: stop.owner is None):
        printed = _report(stop, as_json)
        code = code or stop.code or (exits.DONE if printed else exits.FAILED)
    for trouble in troubles:
        recent_complaints.append(trouble)
        _print(f"cocoro: {trouble}", sys.stderr)
    return code


def by_path(robot: str | None) -> tuple[list[StopResult], list[str]]:
    """Stops by the stop path; returns the result of each robot, and the problems."""
    try:
        with Asking(robot) as asking:
            asking.go_on(time.monotonic() + ACKNOWLEDGE_S)
            asking.hear_of_the_disk(time.monotonic() + KEPT_S)
    except OSError as error:
        return [], [f"the stop path cannot be used ({error}): the mesh alone was asked"]
    started_s = _process_start_s()
    groups: dict[tuple[int, str], list[Point]] = {}
    for point in asking.points.values():
        if not point.gone:
            groups.setdefault((point.uid, point.robot), []).append(point)
    return [_stop_of(uid, name, points, started_s) for (uid, name), points in groups.items()], []


def _left_open(robot: str | None, stops: list[StopResult]) -> set[str]:
    """Names of this user's robots that have a running service which the stop path did not stop."""
    own = {stop.robot: stop for stop in stops if stop.owner is None}
    left_open = {stop.robot for stop in own.values() if stop.missing}
    from deploy.rundir import RunDir, folders  # slow to import; by now every stop has been sent

    for run_dir in folders() if robot is None else [RunDir(robot)]:
        unstopped = {*STOPPABLE} - {*(own[run_dir.robot].acknowledged if run_dir.robot in own else ())}
        if unstopped and unstopped & {*run_dir.claims()}:
            left_open.add(run_dir.robot)
    return left_open


def _stop_of(uid: int, robot: str, points: list[Point], started_s: float) -> StopResult:
    there = {point.service for point in points}
    silent = {point.service for point in points if point.latched_ns is None}
    acknowledged = sorted(there - silent, key=movers_first)
    missing = silent - {EXECUTIVE}
    latched_s = [point.latched_ns / 1e9 for point in points if point.latched_ns is not None]
    return StopResult(
        robot,
        tuple(acknowledged),
        tuple(sorted(missing, key=movers_first)),
        tuple(service for service in STOPPABLE if service not in there),
        max(latched_s, default=time.monotonic()) - started_s,
        tuple(dict.fromkeys(point.why_not_kept for point in points if point.kept is False)),
        tuple(point.service for point in points if point.latched_ns is not None and not point.settled),
        None if uid == os.getuid() else uid,
        {point.service: point.latched_ns for point in points if point.latched_ns is not None},
    )


def _by_mesh_too(
    robot: str | None,
    site: str | None,
    only: set[str] | None,
    started_s: float,
    stops: list[StopResult],
    troubles: list[str],
) -> tuple[list[StopResult], list[str], int]:
    """Stops on the mesh the robots in `only` (None: all); returns merged results, problems and the exit code."""
    from cocoro.errors import CocoroError, ConfigError

    try:
        which = []
        if site is not None or stops or _up(robot):
            from apps.cli import estop_mesh  # slow to import

            which = [one for one in estop_mesh.found(robot, site) if only is None or one[0].robot in only]
        if not which and not stops:
            name = "no robot" if robot is None else f"no {robot}"
            return [], [*troubles, f"{name} is up on this machine: start one with `cocoro up sim`"], exits.NO_MESH
        by_mesh, errors = estop_mesh.stop_all(which, started_s)
    except (CocoroError, OSError) as error:
        code = exits.USAGE if isinstance(error, ConfigError) and not stops else exits.FAILED
        return stops, [*troubles, str(error)], code
    troubles = [*troubles, *map(str, errors)]
    code = exits.DONE if not errors else exits.FAILED if by_mesh or stops else exits.NO_MESH
    return [*_merged(stops, by_mesh)], troubles, code


def _up(robot: str | None) -> bool:
    """Whether this user has a robot on this machine, or this one."""
    from deploy.rundir import RunDir, robots

    return bool(robots()) if robot is None else RunDir(robot).populated


def _merged(by_path: list[StopResult], by_mesh: list[StopResult]) -> list[StopResult]:
    """Merges the results of both ways: a service that acknowledged on either is stopped."""
    found = {stop.robot: stop for stop in by_mesh}
    merged = []
    for one in by_path:
        if (other := found.pop(one.robot, None) if one.owner is None else None) is not None:
            acknowledged = {*one.acknowledged, *other.acknowledged}
            missing = {*one.missing, *other.missing} - acknowledged
            absent = tuple(name for name in one.absent if name not in acknowledged | missing)
            one = one._replace(
                acknowledged=tuple(sorted(acknowledged, key=movers_first)),
                missing=tuple(sorted(missing, key=movers_first)),
                absent=absent,
                seconds=max(one.seconds, other.seconds),
                not_kept=(*one.not_kept, *other.not_kept),
            )
        merged.append(one)
    return [*merged, *found.values()]


def _report(stop: StopResult, as_json: bool) -> bool:
    if as_json:
        import json

        output.told = True
        text = json.dumps(stop._asdict())
    else:
        text = str(stop)
    return _print(text, sys.stderr if stop.code and not as_json else sys.stdout)


def _print(text: str, file: TextIO | None) -> bool:
    """Prints a line; returns whether it was written. Output that is lost changes nothing about the stop."""
    try:
        print(text, file=file, flush=True)
    except UnicodeError:
        return _print(ascii(text), file)
    except (OSError, ValueError):
        return False
    return True


def _process_start_s() -> float:
    """Start of this process on the monotonic clock, s: the operator's Enter to 10 ms (proc_pid_stat(5))."""
    try:
        with open("/proc/self/stat") as stat:  # noqa: PTH123 # importing pathlib takes as long as the stop
            ticks = int(stat.read().rpartition(")")[2].split()[19])
        age_s = time.clock_gettime(time.CLOCK_BOOTTIME) - ticks / os.sysconf("SC_CLK_TCK")
    except (OSError, AttributeError):  # no /proc
        age_s = 0.0
    return time.monotonic() - age_s
