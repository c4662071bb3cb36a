"""Projection matrices and the tint of a lamp, shared by both renderers."""

from __future__ import annotations

from dataclasses import replace
from math import ceil

import numpy as np

from cocoro.arrays import FloatArray
from cocoro.robot import Camera

NEAR_M = 0.03
FAR_M = 60.0
PROJECTOR_NEAR_M = 0.2
PROJECTOR_BIAS_PER_M = 0.005
"""Least difference in 1 / z at which a surface shades the one behind it: 5 mm at 1 m, 2 cm at 2 m, a fifth of a pixel
of disparity. It keeps slanted surfaces from shading themselves."""


def rigid_inverse(pose: FloatArray) -> FloatArray:
    """Inverse of a rigid transform, (4, 4)."""
    inverse = np.eye(4)
    inverse[:3, :3] = pose[:3, :3].T
    inverse[:3, 3] = -pose[:3, :3].T @ pose[:3, 3]
    return inverse


def projection(camera: Camera, near_m: float = NEAR_M, far_m: float = FAR_M) -> FloatArray:
    """Matrix (4, 4) from the camera's frame (x right, y down, z forward) to clip space.

    Row 0 of the picture is at y = -1. OpenGL returns rows from y = -1 upwards, so the picture needs no flip. Pixel i
    covers i - 0.5 to i + 0.5 (see `cocoro.robot.Camera`), so -0.5 is at -1 and width - 0.5 at +1.
    """
    w, h = camera.width, camera.height
    depth = far_m - near_m
    return np.array(
        [
            [2 * camera.fx / w, 0.0, (2 * camera.cx + 1) / w - 1, 0.0],
            [0.0, 2 * camera.fy / h, (2 * camera.cy + 1) / h - 1, 0.0],
            [0.0, 0.0, (far_m + near_m) / depth, -2 * far_m * near_m / depth],
            [0.0, 0.0, 1.0, 0.0],
        ]
    )


def projector_camera(camera: Camera, baseline_m: float) -> Camera:
    """The infrared projector as a camera: the depth camera's pixels with a margin on both sides, wide enough to cover
    everything that the depth camera, `baseline_m` beside it, sees beyond half a metre."""
    margin = ceil(camera.fx * baseline_m / 0.5)
    return replace(camera, width=camera.width + 2 * margin, cx=camera.cx + margin)


def lamp_view(direction: FloatArray, centre_m: FloatArray, half_width_m: float, texels: int) -> FloatArray:
    """Matrix (4, 4) from the world to the clip space of a parallel light along `direction` (3,): it covers the cube of
    that half width around `centre_m` (3,).

    The centre is rounded to the texel grid, so that shadows do not flicker when the centre moves.
    """
    forward = direction / np.linalg.norm(direction)
    helper = np.array([1.0, 0.0, 0.0]) if abs(forward[0]) < 0.9 else np.array([0.0, 1.0, 0.0])
    right = np.cross(helper, forward)
    right /= np.linalg.norm(right)
    axes = np.stack([right, np.cross(forward, right), forward])
    texel_m = 2 * half_width_m / texels
    offset = np.round(axes @ centre_m / texel_m) * texel_m
    view = np.eye(4)
    view[:3, :3] = axes / half_width_m
    view[:3, 3] = -offset / half_width_m
    return view


def lamp_tint(temperature_k: float) -> FloatArray:
    """RGB factors (3,) of a lamp with this colour temperature, to multiply display values with.

    Planckian locus (cubic fit of Kim et al., US patent 7024034, 1667 to 25000 K, clipped outside) to linear sRGB (IEC
    61966-2-1), relative to 6500 K and scaled to a largest channel of 1, then the display's gamma.
    """
    rgb = _planck_rgb(temperature_k) / _planck_rgb(6500.0)
    tint: FloatArray = (rgb / rgb.max()) ** (1 / 2.2)
    return tint


def _planck_rgb(temperature_k: float) -> FloatArray:
    k = 1000.0 / min(max(temperature_k, 1667.0), 25000.0)
    if k > 1 / 4:
        x = ((-0.2661239 * k - 0.2343589) * k + 0.8776956) * k + 0.179910
    else:
        x = ((-3.0258469 * k + 2.1070379) * k + 0.2226347) * k + 0.240390
    if k > 1 / 2.222:
        y = ((-1.1063814 * x - 1.34811020) * x + 2.18555832) * x - 0.20219683
    elif k > 1 / 4:
        y = ((-0.9549476 * x - 1.37418593) * x + 2.09137015) * x - 0.16748867
    else:
        y = ((3.0817580 * x - 5.87338670) * x + 3.75112997) * x - 0.37001483
    xyz = np.array([x / y, 1.0, (1 - x - y) / y])
    to_srgb = np.array([[3.2406, -1.5372, -0.4986], [-0.9689, 1.8758, 0.0415], [0.0557, -0.2040, 1.0570]])
    rgb: FloatArray = np.maximum(to_srgb @ xyz, 1e-3)
    return rgb
