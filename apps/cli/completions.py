"""Names for the shell to complete: of objects, scenes, profiles, robots, captures, services, topics and the like.

Each function gets the beginning of a word and returns the names that begin so. A shell calls the command for each press
of the Tab key, so a function imports little, and an error becomes no names.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import wraps


def _names(find: Callable[[], Iterable[str]]) -> Callable[[str], list[str]]:
    """A completion from a function that returns all names."""

    @wraps(find)
    def complete(incomplete: str) -> list[str]:
        try:
            return [name for name in find() if name.startswith(incomplete)]
        except Exception:  # whatever is wrong here, a shell must not be filled with it
            return []

    del complete.__wrapped__  # typer reads the signature
    return complete


@_names
def labels() -> Iterable[str]:
    """Labels of the objects that the robot knows which is up here, else of the project's own."""
    from pathlib import Path

    from cocoro.objects import Catalogue
    from deploy.rundir import robots

    files = {run_dir.resolved().get("objects") for run_dir in robots()}
    file = files.pop() if len(files) == 1 else None
    return [known.label for known in Catalogue.load(Path(file) if file else None).targets]


@_names
def policies() -> Iterable[str]:
    """Learned policies that the profiles of the robots name which are up here."""
    from deploy.rundir import robots

    tables = (run_dir.resolved().get("service", {}).get("policy", {}) for run_dir in robots())
    return [name for table in tables for name in table.get("policies", {})]


@_names
def scenes() -> Iterable[str]:
    from sim.scene_names import GENERATED, scene_names

    return [*scene_names(), *GENERATED]


@_names
def profiles() -> Iterable[str]:
    from deploy.profiles import names

    return names()


@_names
def robots() -> Iterable[str]:
    from deploy.rundir import robots as up

    return [run_dir.robot for run_dir in up()]


@_names
def described() -> Iterable[str]:
    """Robots that are up here, and those whose descriptions the project ships."""
    from cocoro.description import SHIPPED

    return dict.fromkeys([*SHIPPED, *robots("")])


@_names
def processes() -> Iterable[str]:
    from deploy.processes import components

    return [component.name for component in components()]


@_names
def services() -> Iterable[str]:
    from deploy.processes import components

    return dict.fromkeys(service for component in components() for service in (component.name, *component.services))


@_names
def topics() -> Iterable[str]:
    from cocoro.installed import all_topics

    names = [topic.name for topic in all_topics()]
    return dict.fromkeys(name.replace("{service}", service) for name in names for service in services(""))


@_names
def joints() -> Iterable[str]:
    """Joints of the robot that is up here, else of the Calliope."""
    from deploy.which_robot import files_here

    return files_here(None).load().joints


@_names
def roles() -> Iterable[str]:
    from deploy.site.roles import ROLES

    return ROLES


@_names
def principals() -> Iterable[str]:
    """Names that have a certificate of the site that is set."""
    from deploy.site import admitted, place

    return admitted.read(place.folder()).names


def of(*names: str) -> Callable[[str], list[str]]:
    """A completion of the given names."""
    return _names(lambda: names)


@_names
def captures() -> Iterable[str]:
    """Names of captures, and of the tasks in them."""
    from apps.captures.names import shelf
    from cocoro.capture.folder import IDLE, parsed_name

    there = shelf()
    labels = (name.label for _, path in there if (name := parsed_name(path)) and name.label not in ("", IDLE))
    return dict.fromkeys([*(name for name, _ in there), *labels])
