"""Policies as ONNX files, run by ONNX Runtime.

Inputs are named as the features: `observation.state`, float32, (1, values); `observation.images.kinect`, float32,
(1, 3, height, width), from 0 to 1. The output `action`, or the only one, is float32: (1, chunk, values), or without one
or both of the first sides. What it declares lies in NAME.toml beside the file, or as TOML in the file's metadata under
`cocoro`.
"""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from cocoro.errors import field_text
from cocoro.features import ACTION, PICTURES, STATE, PolicyFeatures
from cocoro.policy import Observation, PolicyError
from services.policy.config import PolicyServiceConfig

METADATA = "cocoro"


class OnnxPolicy:
    def __init__(self, path: Path, config: PolicyServiceConfig) -> None:
        """Raises PolicyError when ONNX Runtime is not installed, and for a file that is no policy."""
        try:
            import onnxruntime
        except ModuleNotFoundError as error:
            raise PolicyError(f"{path.name} needs {error.name}: pip install 'cocoro-mesh[policy]'") from error
        if not path.is_file():
            raise PolicyError(f"there is no file {path}")
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = config.threads
        options.inter_op_num_threads = 1
        options.log_severity_level = 3
        try:
            self._session: Any = onnxruntime.InferenceSession(str(path), options, providers=[*config.providers])
        except Exception as error:  # its errors have no common type
            raise PolicyError(f"{path}: {error}") from error
        self.features = _features(path, self._session)
        self._inputs = {one.name: one for one in self._session.get_inputs()}
        outputs = [one.name for one in self._session.get_outputs()]
        if ACTION not in outputs and len(outputs) != 1:
            raise PolicyError(f"{path}: its outputs are {', '.join(outputs)}, none is called {ACTION}")
        self._output = ACTION if ACTION in outputs else outputs[0]
        self._check(path)

    def _check(self, path: Path) -> None:
        """Refuse inputs that no observation has, or that have other sizes than what is declared."""
        features = self.features
        sizes: dict[str, tuple[int, ...]] = {STATE: (1, len(features.state))}
        if features.width is not None and features.height is not None:
            sizes[PICTURES] = (1, 3, features.height, features.width)
        for name, one in self._inputs.items():
            if name not in sizes:
                raise PolicyError(f"{path}: its input {name} is none of {', '.join(sizes)}")
            if one.type != "tensor(float)":
                raise PolicyError(f"{path}: its input {name} is a {one.type}, not a tensor(float)")
            fits = len(one.shape) == len(sizes[name]) and all(
                not isinstance(side, int) or side == want for side, want in zip(one.shape, sizes[name], strict=True)
            )
            if not fits:
                raise PolicyError(f"{path}: its input {name} has the shape {one.shape}, {[*sizes[name]]} was declared")

    def reset(self) -> None:
        """A network without memory has nothing to forget."""

    def act(self, observation: Observation) -> np.ndarray[Any, Any]:
        given = {}
        if STATE in self._inputs:
            given[STATE] = observation[STATE][None]
        if PICTURES in self._inputs:
            given[PICTURES] = np.ascontiguousarray(observation[PICTURES].transpose(2, 0, 1)[None], np.float32) / 255.0
        (actions,) = self._session.run([self._output], given)
        found: np.ndarray[Any, Any] = actions[0] if actions.ndim == 3 and len(actions) == 1 else actions
        return found


def _features(path: Path, session: Any) -> PolicyFeatures:
    beside = path.with_suffix(".toml")
    text = session.get_modelmeta().custom_metadata_map.get(METADATA)
    where = f"{path}, metadata {METADATA!r}"
    if beside.is_file():
        text, where = beside.read_text(encoding="utf-8"), str(beside)
    if text is None:
        raise PolicyError(f"{path} declares no features: it has no metadata {METADATA!r}, and there is no {beside}")
    try:
        return msgspec.convert(tomllib.loads(text), PolicyFeatures)
    except msgspec.ValidationError as error:
        raise PolicyError(f"{where}: {field_text(error, PolicyFeatures)}") from error
    except ValueError as error:
        raise PolicyError(f"{where}: {error}") from error
