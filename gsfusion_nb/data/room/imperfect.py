"""What a hand-held recording gets wrong, added to the room: poses, brightness, surfaces without depth. The truth stays
known."""

import numpy as np
from numpy import ndarray

_SECONDS = 2.0
"""Errors of poses and brightness wander this fast: about half of them is new after this time."""
_CUBE_M = 0.4
"""Edge of the cubes whose surface gives no depth."""


def wandering(times_s: ndarray, channels: int, rng: np.random.Generator) -> ndarray:
    """Smooth random curves with mean 0 and standard deviation 1 over the whole walk. [n, channels]

    Sums of sines with random phases, of periods from half to four times ``_SECONDS``.
    """
    period = _SECONDS * np.geomspace(0.5, 4.0, 8)[:, None, None]
    phase = rng.uniform(0, 2 * np.pi, (8, 1, channels))
    return np.sqrt(2 / 8) * np.sin(2 * np.pi * times_s[None, :, None] / period + phase).sum(0)


def disturbed_poses(T_WC: ndarray, times_s: ndarray, sigma_m: float, sigma_deg: float, seed: int) -> ndarray:
    """Poses T_WC exp(xi) with an error xi that wanders: in each direction of the camera ``sigma_m`` and ``sigma_deg``.
    [n, 4, 4]"""
    from scipy.spatial.transform import Rotation

    xi = wandering(times_s, 6, np.random.default_rng([seed, 5]))
    error = np.tile(np.eye(4), (len(T_WC), 1, 1))
    error[:, :3, :3] = Rotation.from_rotvec(np.radians(sigma_deg) * xi[:, 3:]).as_matrix()
    error[:, :3, 3] = sigma_m * xi[:, :3]
    return T_WC @ error


def exposure_gains(times_s: ndarray, sigma_stops: float, seed: int) -> ndarray:
    """Factors of red, green and blue of the linear light in each frame: the brightness wanders by ``sigma_stops``, each
    colour by a fifth of that on its own (white balance). [n, 3]"""
    wander = wandering(times_s, 4, np.random.default_rng([seed, 6]))
    return 2.0 ** (sigma_stops * (wander[:, :1] + 0.2 * wander[:, 1:]))


def exposed(rgb_u8: ndarray, gain: ndarray) -> ndarray:
    """The picture with another exposure: its light, colour ** 2.2, times ``gain``; what is too bright is white."""
    levels = np.clip((np.arange(256) / 255.0)[:, None] * gain ** (1 / 2.2), 0, 1)
    table = np.rint(255 * levels).astype(np.uint8)
    return np.stack([table[rgb_u8[..., c], c] for c in range(3)], axis=-1)


def without_depth(xyz_W: ndarray, share: float, seed: int) -> ndarray:
    """Which points lie in a cube of 40 cm whose surface gives no depth, seen from anywhere: this share of the cubes."""
    cube = np.floor(xyz_W / _CUBE_M).astype(np.int64) + 512
    chance = np.random.default_rng([seed, 7]).uniform(size=1 << 14)
    hashed = (cube[..., 0] * 73856093) ^ (cube[..., 1] * 19349663) ^ (cube[..., 2] * 83492791)
    return chance[hashed % len(chance)] < share
