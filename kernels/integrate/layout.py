"""What the numba kernels of integration are given: the frame's images, the camera, the settings, the voxels."""

from typing import NamedTuple

import numpy as np


class View(NamedTuple):
    """Pose [4, 4] and intrinsic matrix [3, 3] of the camera, float64; one is added to the principal point."""

    T_CW: np.ndarray
    K: np.ndarray


class Limits(NamedTuple):
    """Metres, float64; the largest weight is a count."""

    far: float
    truncation: float
    voxel_size: float
    max_weight: float
    colour_band: float
    """Half width of the band in which colours count, metres; 0: all do."""


class Method(NamedTuple):
    """Whether distances are along the ray, how they are averaged, a number of ``numba._AVERAGES``, and whether colours
    have weights of their own, and they fall with the distance."""

    along_ray: bool
    average: int
    weighs_colours: bool
    colour_by_distance: bool


class Voxels(NamedTuple):
    """The blocks [B, 3] and the values of their voxels, block after block."""

    coords: np.ndarray
    D: np.ndarray
    W: np.ndarray
    rgb: np.ndarray
    W_rgb: np.ndarray


class Image(NamedTuple):
    """Depth and 8-bit colour of every pixel in one word, and colours that are float32: empty if they are bytes."""

    packed: np.ndarray
    rgb: np.ndarray
