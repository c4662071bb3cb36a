"""Reading and writing picture files with OpenCV, with errors reported."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from cocoro.errors import CocoroError


def save(image: NDArray[Any], path: Path) -> None:
    """Write an image (BGR (h, w, 3), or depth (h, w)) as PNG; a partly written file is removed. Raises OSError,
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
    """Read a picture file as BGR (h, w, 3), or by `flags`; None when it is no picture. Raises OSError.

    OpenCV crashes on file names that are not UTF-8, so the file is read here.
    """
    data = np.frombuffer(path.read_bytes(), dtype=np.uint8)
    return cv2.imdecode(data, flags) if data.size else None
