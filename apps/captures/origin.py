"""What a service was started with, by a capture; and its core, made of that again."""

from __future__ import annotations

import base64
import hashlib
import json
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any, TypeVar

import msgspec

from cocoro.capture.errors import CaptureError
from cocoro.capture.reader import Capture
from cocoro.component import Implementation
from cocoro.component import load as load_component
from cocoro.core import Core
from cocoro.errors import ConfigError
from cocoro.robot import Robot
from deploy import processes

T = TypeVar("T")


@dataclass(frozen=True)
class Origin:
    """One start of a service."""

    service: str
    implementation: Implementation[Any]
    robot: Robot
    config: Any
    latency_s: float

    def core(self) -> Core:
        """A new core, as it was at the start."""
        assert self.implementation.core is not None
        return self.implementation.core(self.robot, self.config)


@contextmanager
def origins(captures: Sequence[Capture], service: str) -> Iterator[list[Origin]]:
    """Every start of a service that the captures tell of, in order. Within the context its files are there.

    Raises CaptureError when there is none, or when its core cannot be made here.
    """
    told = [entries for capture in captures for entries in capture.every_metadata(f"service/{service}")]
    starts = [entries for n, entries in enumerate(told) if entries not in told[:n]]
    path = captures[0].path
    if not starts:
        there = sorted({name[8:] for capture in captures for name in capture.metadata if name.startswith("service/")})
        raise CaptureError(
            f"{path}: it does not say what {service} was started with; it does of {', '.join(there) or 'none'}"
        )
    with tempfile.TemporaryDirectory(prefix="cocoro-") as folder:
        try:
            made = [_origin(service, entries, Path(folder) / str(n)) for n, entries in enumerate(starts)]
        except (KeyError, TypeError, ValueError, ConfigError) as error:
            raise CaptureError(f"{path}: what {service} was started with cannot be had again: {error}") from error
        yield made


def recorded_file(capture: Capture, service: str, field: str, load: Callable[[Path | None], T]) -> T:
    """What a loader makes of a file that a service was configured with, as it was then (None: not told)."""
    told = json.loads(capture.metadata.get(f"service/{service}", {}).get("files", "[]"))
    content = next((base64.b64decode(file["content"]) for file in told if file["field"] == field), b"")
    if not content:
        return load(None)
    with tempfile.NamedTemporaryFile(suffix=".toml") as copy:
        copy.write(content)
        copy.flush()
        return load(Path(copy.name))


def _origin(service: str, entries: Mapping[str, str], folder: Path) -> Origin:
    module = entries["module"]
    component = processes.by_module(module)
    if component is None:
        raise ConfigError(f"no component that is installed here has the module {module!r}")
    implementation = load_component(component)
    if implementation.core is None:
        raise CaptureError(f"{service} cannot be executed again: {module} has no pure core")
    settings = json.loads(entries["config"])
    for file in json.loads(entries["files"]):
        settings[file["field"]] = _same_file(file, folder, settings.get(file["field"]))
    try:
        config = msgspec.convert(settings, implementation.config)
    except msgspec.ValidationError as error:
        raise ConfigError(f"it was configured for another version: {error}") from error
    robot = Robot.from_data(json.loads(entries["description"]), "the recorded robot description")
    return Origin(service, implementation, robot, config, float(entries["latency_s"]))


def _same_file(file: Mapping[str, str], folder: Path, configured: str | None) -> str | None:
    """What to configure so that the file is the one of then: what was, if that is still it, else the recorded copy."""
    content = base64.b64decode(file["content"])
    try:
        if configured is not None:
            today = Path(configured).read_bytes()
        else:
            today = resources.files("cocoro").joinpath(file["path"]).read_bytes()
    except OSError:
        today = b""
    if hashlib.sha256(today).hexdigest() == file["sha256"]:
        return configured
    if not content:
        raise ConfigError(f"it needs the file {file['path']} of sha256 {file['sha256']}, which is not here")
    folder.mkdir(exist_ok=True)
    copy = folder / Path(file["path"]).name
    copy.write_bytes(content)
    return str(copy)
