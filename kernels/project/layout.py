"""What the numba kernels of projection are given: the camera as one array, and the parameters of a map."""

from typing import NamedTuple

import numpy as np

from gsfusion_nb.types import Camera

from .lens import projection_lens

R00, R01, R02, R10, R11, R12, R20, R21, R22, T0, T1, T2 = range(12)
CENTRE_X, CENTRE_Y, CENTRE_Z, FX, FY, CX, CY, LIMIT_X, LIMIT_Y, WIDTH, HEIGHT = range(12, 23)
"""The camera as 23 float32: R_CW, t_CW, its centre, fx, fy, cx, cy, limits of x/z and y/z in J, image size."""


class Params(NamedTuple):
    """The parameters of a map, or dL/d of each, one Gaussian a row. float32"""

    xyz: np.ndarray
    log_scale: np.ndarray
    quat: np.ndarray
    logit: np.ndarray
    sh: np.ndarray


def pack_camera(camera: Camera, T_CW: np.ndarray, centre_W: np.ndarray) -> np.ndarray:
    """The camera and its pose as one float32 array, in the order of the constants above."""
    tail = [*projection_lens(camera), camera.width, camera.height]
    return np.concatenate([T_CW[:3, :3].ravel(), T_CW[:3, 3], centre_W, tail]).astype(np.float32)
