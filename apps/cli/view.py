"""`cocoro view`: a capture or a running robot in Rerun: in a window, in a browser, in a file, or elsewhere."""

from __future__ import annotations

import asyncio
import sys
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from apps.captures.export.viewer import Attempt, Pulse, Target, ViewerProcess, refuse_nobody, sent, temporary_rrd
from apps.captures.info import left_out_notes
from apps.cli import exits
from apps.cli.export import progress_bar
from apps.cli.interrupt import interrupt_event
from apps.cli.link import MeshLink, joined
from apps.cli.options import RobotChoice, RobotOption, ThroughOption, capture_file
from apps.cli.viewed import Waiting, watch
from cocoro.capture.conventions import CaptureError
from cocoro.capture.reader import Capture
from cocoro.errors import ConfigError
from cocoro.messages import AboutRequest
from cocoro.topics import ABOUT

if TYPE_CHECKING:
    from sim.outside import OutsideStage

FLUSH_S = 10.0
LOOK_S = 0.2
"""How often it is seen that the viewer was closed."""

app = typer.Typer()


@app.command()
def view(
    file: Annotated[
        Path | None,
        typer.Argument(
            metavar="[FILE]", parser=capture_file, help="A capture; without one, the running robot is shown."
        ),
    ] = None,
    sim: Annotated[
        bool, typer.Option("--sim", help="Show the simulated robot and its scene from outside; the mouse turns it.")
    ] = False,
    web: Annotated[bool, typer.Option("--web", help="Serve it as a page for a browser; needs no display.")] = False,
    bind: Annotated[
        str,
        typer.Option(
            "--bind", metavar="ADDRESS", help="With --web or --foxglove: serve it here; 0.0.0.0 is every address."
        ),
    ] = "127.0.0.1",
    save: Annotated[
        Path | None, typer.Option("--save", metavar="OUT.rrd", help="Write it to a file for Rerun; needs no display.")
    ] = None,
    connect: Annotated[
        str | None, typer.Option("--connect", metavar="HOST[:PORT]", help="Send it to a viewer that runs there.")
    ] = None,
    foxglove: Annotated[
        bool, typer.Option("--foxglove", help="Serve the running robot to Foxglove; needs cocoro-mesh[foxglove].")
    ] = False,
    port: Annotated[
        int | None, typer.Option("--port", min=0, max=65535, help="With --foxglove: serve it here, by default 8765.")
    ] = None,
    layout: Annotated[
        Path | None,
        typer.Option("--layout", metavar="OUT.json", help="With --foxglove: write the layout that Foxglove imports."),
    ] = None,
    operate: Annotated[
        bool,
        typer.Option("--operate", help="With --foxglove: take tasks, too, from this user's programs on this machine."),
    ] = False,
    robot: RobotOption = None,
    site: ThroughOption = None,
) -> None:
    """Open Rerun on a capture, or live on the mesh; or serve the robot to Foxglove. Needs the extra `view` or
    `foxglove`."""
    if foxglove:
        others = {"a FILE": file, "--sim": sim, "--web": web, "--save": save, "--connect": connect}
        if given := [name for name, value in others.items() if value]:
            raise ConfigError(
                f"--foxglove shows the running robot: leave out {', '.join(given)}; "
                "for a capture there is `cocoro export FILE --foxglove OUT.mcap`"
            )
        from apps.cli import view_foxglove

        place = view_foxglove.Place(bind, view_foxglove.DEFAULT_PORT if port is None else port, operate, layout)
        sys.exit(asyncio.run(view_foxglove.serve(RobotChoice(robot, site), place)))
    if port is not None or layout is not None or operate:
        raise ConfigError("--port, --layout and --operate are for --foxglove; give that, too")
    target = Target(save=save, web=web, bind=bind, connect=connect)
    if file is not None:
        sys.exit(view_file(file, target, sim))
    sys.exit(asyncio.run(view_mesh(RobotChoice(robot, site), target, sim)))


# --- a capture ------------------------------------------------------------------------------------


def view_file(file: Path, target: Target, sim: bool = False) -> int:
    """Shows a capture, until the viewer is closed or Ctrl-C.

    Raises CaptureError when Rerun is not installed, the file cannot be read, or the viewer cannot be reached;
    ConfigError when there is no display, or nothing that `target` says.
    """
    from apps.captures.export.rerun_scene import APPLICATION, export, library, log_capture

    rerun = library()
    target.check()
    with Capture.open(file) as capture:
        stage = _recorded_stage(capture) if sim else None
        if target.connect is not None:
            address = refuse_nobody(target.connect)
            recording = rerun.RecordingStream(APPLICATION)
            recording.connect_grpc(address)

            def log(pulse: Pulse) -> int:
                count = log_capture(capture, recording, lambda _: pulse.beat(), stage)
                recording.flush(timeout_sec=FLUSH_S)
                return count

            print(f"{sent(log, target.connect)} messages are in the viewer at {target.connect}")
        elif target.save is not None:
            with progress_bar(capture, target.save) as show:
                count = export(capture, target.save, show, stage)
            print(f"{target.save}: {count} messages; open it with `rerun {target.save}`")
        else:
            _show(capture, target, stage, export)
        for problem in capture.problems:
            print(f"missing: {problem}", file=sys.stderr)
        for note in left_out_notes(capture):
            print(f"note: {note}", file=sys.stderr)
        return exits.FAILED if capture.problems else exits.DONE


def _recorded_stage(capture: Capture) -> OutsideStage:
    from apps.captures.export.stage import recorded_stage

    return recorded_stage(capture)


def _show(capture: Capture, target: Target, stage: OutsideStage | None, export: Callable[..., int]) -> None:
    """Show a capture in a window or a browser. A file is made first, so that nothing waits for a viewer that takes
    nothing."""
    with temporary_rrd() as rrd:
        with progress_bar(capture, capture.path) as show:
            count = export(capture, rrd, show, stage)
        with ViewerProcess(target, rrd) as viewer, suppress(KeyboardInterrupt):
            if viewer.page:
                viewer.wait_until_ready()
                print(f"{count} messages at {viewer.page}\nCtrl-C ends it", flush=True)
            else:
                print(f"{count} messages are in Rerun; close its window, or Ctrl-C here", flush=True)
            viewer.wait()


# --- a running robot ------------------------------------------------------------------------------


async def view_mesh(choice: RobotChoice, target: Target, sim: bool = False) -> int:
    """Shows a robot's mesh, until the viewer is closed or Ctrl-C.

    Raises CaptureError when Rerun is not installed or the viewer cannot be reached, ConfigError when there is no
    display, MeshError when there is no mesh.
    """
    from apps.captures.export.files import making
    from apps.captures.export.rerun_scene import APPLICATION, RerunScene, flush, library

    rerun = library()
    target.check()
    address = refuse_nobody(target.connect) if target.connect is not None else None
    async with joined(choice, frames=True) as link:
        stage = await _stated_stage(link) if sim else None
        recording = rerun.RecordingStream(APPLICATION)
        viewer: ViewerProcess | None = None
        try:
            if target.save is not None:
                with making(target.save):
                    recording.save(str(target.save))
            elif address is None:
                viewer = ViewerProcess(target)
                viewer.wait_until_ready()
                address = viewer.address
            if address is not None:
                recording.connect_grpc(address)
            waiting = Waiting()
            watch(link.bus, link.robot, waiting)
            scene = RerunScene(recording, await link.described(), link.catalogue(), stage)
            writing = Attempt(partial(waiting.log_to, scene))
            print(f"at {viewer.page}\nCtrl-C ends it" if viewer and viewer.page else "Ctrl-C ends it", flush=True)
            with interrupt_event() as end:
                while not end.is_set() and not writing.join(0.0) and not (viewer is not None and viewer.ended):
                    with suppress(TimeoutError):
                        async with asyncio.timeout(LOOK_S):
                            await end.wait()
            waiting.close()
            if viewer is not None and viewer.failed:
                raise CaptureError(viewer.reason())
            if viewer is None or not viewer.ended:
                flushing = Attempt(partial(flush, recording, target.save) if target.save else recording.flush)
                if not (writing.join(FLUSH_S) and flushing.join(FLUSH_S)):
                    raise CaptureError(f"the viewer took nothing any more; {waiting.dropped} messages were not shown")
                writing.result()
                flushing.result()
            return exits.DONE
        finally:
            if viewer is not None:
                viewer.close()


async def _stated_stage(link: MeshLink) -> OutsideStage:
    """The stage of the robot's simulator. Raises ConfigError when the robot is not simulated."""
    from apps.captures.export.stage import SIMULATORS, stated_stage

    for answer in await link.call_all(ABOUT.of("*"), AboutRequest()):
        if answer.reply is not None and answer.reply.module in SIMULATORS:
            return stated_stage(answer.reply)
    raise ConfigError(f"--sim: {link.robot} has no simulator that runs; leave --sim out to see what the robot reports")
