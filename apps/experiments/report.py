"""The report of the experiments: Markdown, HTML in one file, JSON, and a manifest of versions and settings."""

from __future__ import annotations

import base64
import html
import json
import platform
from collections.abc import Iterator, Sequence
from importlib import metadata
from pathlib import Path
from typing import Any

import msgspec

from apps.experiments.plan import ExperimentSettings
from apps.experiments.results import ResultRow, Section
from cocoro.about import DISTRIBUTIONS
from cocoro.errors import naming
from cocoro.learning.handmap import fingerprint_of

HEADS = ("measure", "who", "mean ± 95% CI", "worst", "unit", "wanted", "", "the paper's text")
DOTS_PER_INCH = 90
_STYLE = """body{font:15px/1.5 system-ui,sans-serif;max-width:70rem;margin:2rem auto;padding:0 1rem;color:#222}
table{border-collapse:collapse;font-size:13px;width:100%;display:block;overflow-x:auto}
th,td{text-align:left;padding:.25rem .6rem;border-bottom:1px solid #ddd;vertical-align:top}
tr.ours{background:#eef5fa} td.missed{color:#b00020;font-weight:600} td.held{color:#2e7d32}
figure{margin:1.5rem 0} img{max-width:100%} figcaption{color:#555;font-size:13px} h2{margin-top:3rem}"""


def write(sections: Sequence[Section], settings: ExperimentSettings, *, plots: bool) -> Path:
    """Writes report, plots and manifest into the settings' folder; returns the path of the Markdown file."""
    folder = settings.out
    folder.mkdir(parents=True, exist_ok=True)
    if plots:
        for section in sections:
            for plot in section.plots:
                plot.draw().savefig(folder / f"{plot.name}.png", dpi=DOTS_PER_INCH)
    manifest = _manifest(settings)
    data = {"settings": manifest["settings"], "sections": [section.data() for section in sections]}
    _write(folder / "report.json", json.dumps(data, indent=1, allow_nan=False) + "\n")
    _write(folder / "manifest.json", json.dumps(manifest, indent=1) + "\n")
    _write(folder / "report.html", _page(sections, settings, plots))
    path = folder / "report.md"
    _write(path, "\n".join(_markdown(sections, settings, plots)) + "\n")
    return path


def _manifest(settings: ExperimentSettings) -> dict[str, Any]:
    versions = {}
    for name in (*DISTRIBUTIONS, "pybullet", "moderngl", "matplotlib"):
        try:
            versions[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            versions[name] = "not installed"
    robot = settings.robot()
    return {
        "settings": {**msgspec.to_builtins(settings, enc_hook=str), "out": settings.out.name},
        "robot": robot.name,
        "drawing": fingerprint_of(robot),
        "python": platform.python_version(),
        "machine": f"{platform.system()} {platform.machine()}",
        "versions": versions,
    }


def _about(settings: ExperimentSettings) -> str:
    seeds = settings.seeds
    which = f"{seeds[0]} to {seeds[-1]}" if len(seeds) > 1 else str(seeds[0])
    count = f"{len(seeds)} seed" + ("" if len(seeds) == 1 else "s")
    return (
        f"{count} ({which}); sensors {settings.sensors}, body {settings.body}, frames"
        f" {settings.width}x{settings.height} at {settings.frame_rate_hz:g} Hz; virtual time. A row summarises the"
        " seeds, or all runs where it says so; 'worst' is the worst of all. Our rows and the baselines beside them are"
        " measured in the same runs."
    )


def _cells(row: ResultRow) -> tuple[str, ...]:
    return (row.measure, row.who, row.mean, row.worst, row.unit, row.wanted, row.verdict, row.paper)


def _markdown(sections: Sequence[Section], settings: ExperimentSettings, plots: bool) -> Iterator[str]:
    yield "# The paper's experiments"
    yield ""
    yield _about(settings)
    for section in sections:
        yield f"\n## {section.key}: {section.title}\n"
        yield section.about + "\n"
        yield "| " + " | ".join(HEADS) + " |"
        yield "|" + "---|" * len(HEADS)
        for row in section.rows:
            yield "| " + " | ".join(cell.replace("|", "\\|") for cell in _cells(row)) + " |"
        for note in section.notes:
            yield f"\n{note}"
        for error in section.errors:
            yield f"\nA run failed: {error}"
        if plots:
            for plot in section.plots:
                yield f"\n![{plot.caption}]({plot.name}.png)\n\n*{plot.caption}*"


def _page(sections: Sequence[Section], settings: ExperimentSettings, plots: bool) -> str:
    escape = html.escape
    parts = [f"<h1>The paper's experiments</h1><p>{escape(_about(settings))}</p>"]
    for section in sections:
        parts.append(f"<h2>{escape(section.key)}: {escape(section.title)}</h2><p>{escape(section.about)}</p>")
        parts.append("<table><tr>" + "".join(f"<th>{escape(head)}</th>" for head in HEADS) + "</tr>")
        for row in section.rows:
            cells = "".join(
                f'<td class="{cell.lower() if cell == row.verdict else ""}">{escape(cell)}</td>' for cell in _cells(row)
            )
            parts.append(f'<tr class="{"ours" if row.who.startswith("ours") else ""}">{cells}</tr>')
        parts.append("</table>")
        parts += [f"<p>{escape(note)}</p>" for note in section.notes]
        parts += [f"<p>A run failed: {escape(error)}</p>" for error in section.errors]
        if plots:
            parts += [_figure(settings.out / f"{plot.name}.png", plot.caption) for plot in section.plots]
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8"><title>The paper\'s experiments</title>'
        f"<style>{_STYLE}</style></head><body>{''.join(parts)}</body></html>\n"
    )


def _figure(path: Path, caption: str) -> str:
    picture = base64.b64encode(path.read_bytes()).decode()
    text = html.escape(caption)
    return f'<figure><img alt="{text}" src="data:image/png;base64,{picture}"><figcaption>{text}</figcaption></figure>'


def _write(path: Path, text: str) -> None:
    with naming(path):
        path.write_text(text, encoding="utf-8")
