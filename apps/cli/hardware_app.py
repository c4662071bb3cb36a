"""`cocoro doctor`."""

from __future__ import annotations

import sys

import typer

from apps.cli.options import DescriptionOption, JsonOption, MeasuredOption, ProfileArgument

app = typer.Typer()


@app.command()
def doctor(
    profile: ProfileArgument = "robot",
    description: DescriptionOption = None,
    measured: MeasuredOption = None,
    json: JsonOption = False,
) -> None:
    """Look over a machine and its robot before a run; each line is well, or says what to do. Exit code 1 if not."""
    from apps.cli import doctor as looking

    sys.exit(looking.doctor(profile, json, description, measured))
