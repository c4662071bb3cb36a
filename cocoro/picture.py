"""Picture files as OpenCV has them: reading and writing that reports errors."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from cocoro.errors import CocoroError


def save(image: NDArray[Any], path: Path) -> None:
    """Write an image as OpenCV has it (BGR, or depth) as PNG; one that did not get whole does not stay. Raises OSError,
    and CocoroError when it cannot be encoded."""
    done, encoded = cv2.imencode(".png", image)
    if not done:
        raise CocoroError(f"picture {path}: OpenCV cannot encode it")
    try:
        path.write_bytes(encoded.tobytes())
    except OSError as error:
        if error.filename is None and path.is_file():  # it could be opened, and not be written
            path.unlink(missing_ok=True)
        raise


def load(path: Path, flags: int = cv2.IMREAD_COLOR) -> NDArray[Any] | None:
    """A picture file as OpenCV has it (BGR, or what the flags say); None when it is none. Raises OSError.

    OpenCV's own reading of files crashes for a name that is no UTF-8.
    """
    data = np.frombuffer(path.read_bytes(), dtype=np.uint8)
    return cv2.imdecode(data, flags) if data.size else None
