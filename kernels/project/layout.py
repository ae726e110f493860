"""Rows of projected Gaussians, and the numbers of a camera that the kernels read."""

import math
from typing import NamedTuple

import numpy as np
from torch import Tensor

from gsfusion_nb.render.constants import FRUSTUM_CLAMP, NEAR_PLANE_M
from gsfusion_nb.types import Camera, GaussianParams

from ..runtime.arguments import lens_of

COLUMNS = (
    U,
    V,
    CONIC_A,
    CONIC_B,
    CONIC_C,
    LN_OPACITY,
    RED,
    GREEN,
    BLUE,
    DEPTH,
    EXTENT_U,
    EXTENT_V,
) = range(12)
"""Centre, pixels; inverse covariance, sigma = (A dx^2 + C dy^2) / 2 + B dx dy; ln(opacity); colour;
z, metres; half the width and half the height of the ellipse alpha >= 1/255, pixels."""

SPLAT = 12
"""Numbers in a row."""


def projection_lens(
    camera: Camera, near_m: float = NEAR_PLANE_M, far_m: float = math.inf
) -> dict[str, float]:
    """Focal lengths, principal point, the largest |x / z| and |y / z| at which the projection is
    linearised, and the depths between which a centre is drawn."""
    limits = {
        "limit_x": FRUSTUM_CLAMP * 0.5 * camera.width / camera.fx,
        "limit_y": FRUSTUM_CLAMP * 0.5 * camera.height / camera.fy,
        "near_m": near_m,
        "far_m": far_m,
    }
    return lens_of(camera)._asdict() | limits


R00, R01, R02, R10, R11, R12, R20, R21, R22, T0, T1, T2 = range(12)
CENTRE_X, CENTRE_Y, CENTRE_Z, FX, FY, CX, CY, LIMIT_X, LIMIT_Y = range(12, 21)
NEAR, FAR, WIDTH, HEIGHT = range(21, 25)
"""The camera as 25 float32: R_CW, t_CW, its centre, fx, fy, cx, cy, limits of x/z and y/z in J,
depths between which a centre is drawn, image size."""


class Params(NamedTuple):
    """The parameters of a map, or dL/d of each, one Gaussian a row. float32"""

    xyz: np.ndarray
    log_scale: np.ndarray
    quat: np.ndarray
    logit: np.ndarray
    sh: np.ndarray


def arrays_of(params: GaussianParams) -> Params:
    """The columns of a map as arrays; a copy of those with gaps."""
    return Params(*(column.detach().contiguous().numpy() for column in vars(params).values()))


def pack_camera(
    camera: Camera, T_WC: Tensor, near_m: float = NEAR_PLANE_M, far_m: float = math.inf
) -> np.ndarray:
    """The camera and its pose as one float32 array, in the order of the constants above."""
    T = T_WC.detach().double().numpy()  # on so few numbers torch takes twice as long
    R_CW = T[:3, :3].T
    centre = T[:3, 3]
    tail = [*projection_lens(camera, near_m, far_m).values(), camera.width, camera.height]
    return np.array([*R_CW.ravel(), *-(R_CW @ centre), *centre, *tail], np.float32)
