"""Finds policies by name and loads them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

from cocoro.entry_points import added_to, third_partys
from cocoro.errors import choice_of
from cocoro.features import PolicyFeatures
from cocoro.policy import GROUP, Policy, PolicyError
from cocoro.robot import Robot
from services.policy.config import PolicyServiceConfig

ONNX = ".onnx"


class Policies:
    """The policies that a robot has. One that is loaded stays loaded."""

    def __init__(self, robot: Robot, config: PolicyServiceConfig) -> None:
        self._robot = robot
        self._config = config
        self._loaded: dict[str, Policy] = {}

    def names(self) -> list[str]:
        """All that can be found by name."""
        found = [*self._config.policies, *(one.name for one in added_to(GROUP).added)]
        if self._config.folder:
            found += sorted(path.stem for path in Path(self._config.folder).glob(f"*{ONNX}"))
        return list(dict.fromkeys(found))

    def load(self, name: str) -> Policy:
        """The policy of a name, which fits the robot. Takes seconds at the first time. Raises PolicyError."""
        if name not in self._loaded:
            try:
                policy = self._found(name)
                features = getattr(policy, "features", None)
            except PolicyError:
                raise
            except Exception as error:  # a third party's code
                raise PolicyError(f"policy {name} cannot be loaded: {type(error).__name__}: {error}") from error
            if not isinstance(features, PolicyFeatures):
                raise PolicyError(f"policy {name} does not declare its features: `features` is no PolicyFeatures")
            if reason := features.differs(self._robot):
                raise PolicyError(f"policy {name}: {reason}")
            if silent := [joint.name for joint in self._robot.joints.values() if joint.group is None]:
                raise PolicyError(f"policy {name}: nothing tells the angle of {', '.join(silent)}")
            self._loaded[name] = policy
        return self._loaded[name]

    def _found(self, name: str) -> Policy:
        config = self._config
        if name in config.policies:
            return self._from_source(config.policies[name])
        if config.folder and (path := Path(config.folder) / f"{name}{ONNX}").name == f"{name}{ONNX}" and path.is_file():
            return self._from_source(str(path))
        for added in added_to(GROUP).added:
            if added.name == name:
                return self._made(added.value)
        if config.anything and (name.endswith(ONNX) or ":" in name):
            return self._from_source(name)
        names = self.names()
        advice = choice_of(name, names) if names else "it has none: [service.policy] of the profile lists them"
        raise PolicyError(f"the robot has no policy {name!r}; {advice}")

    def _from_source(self, source: str) -> Policy:
        if source.endswith(ONNX):
            from services.policy.onnx import OnnxPolicy

            return OnnxPolicy(Path(source), self._config)
        module, colon, name = source.rpartition(":")
        if not colon:
            raise PolicyError(f"{source!r} is no policy: give an ONNX file, module:callable or file.py:callable")
        make: Any = _module(module)
        for part in name.split("."):
            make = getattr(make, part)
        return self._made(make)

    def _made(self, make: Callable[[Robot], Policy]) -> Policy:
        return make(self._robot)


def _module(name: str) -> ModuleType:
    try:
        return third_partys(name)
    except FileNotFoundError as error:
        raise PolicyError(f"there is no file {name}") from error
