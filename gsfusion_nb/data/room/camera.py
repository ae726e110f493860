"""The camera that is carried through the room: its walk, and what a real one gets wrong: poses,
brightness, surfaces without depth. The truth stays known.
"""

import numpy as np
from numpy import ndarray

_SPEED_M_S = 0.5
_TURN_RAD_S = np.radians(38.0)

_MAPPING = [  # places of the camera, and of what it looks at, metres
    # From the middle of the room, looking outwards at every wall.
    ((0.0, -0.9, 1.50), (-2.4, 0.4, 1.0)),
    ((0.1, 0.2, 1.50), (-2.4, 0.4, 1.1)),
    ((0.2, 0.9, 1.50), (-2.2, 1.6, 1.1)),
    ((0.0, 0.3, 1.45), (-1.0, 2.0, 1.4)),
    ((0.0, -0.3, 1.45), (0.3, 2.0, 1.3)),
    ((-0.3, -0.6, 1.50), (1.6, 1.9, 1.2)),
    ((-0.5, -0.3, 1.50), (2.4, 0.6, 1.2)),
    ((-0.4, 0.3, 1.50), (2.4, -0.6, 1.2)),
    ((-0.3, 0.9, 1.50), (2.0, -1.9, 0.9)),
    ((-0.2, 1.2, 1.50), (0.9, -2.0, 1.1)),
    ((0.1, 1.1, 1.50), (-0.4, -2.0, 1.4)),
    ((0.3, 0.8, 1.50), (-1.7, -2.0, 1.2)),
    ((0.3, 0.2, 1.60), (-2.4, -1.2, 0.9)),
    # Around the furniture, looking down at it.
    ((-0.2, -0.4, 1.50), (-1.6, -0.3, 0.5)),
    ((-0.6, -0.9, 1.45), (-2.2, -1.0, 0.5)),
    ((-1.0, -1.1, 1.40), (-2.0, 0.4, 0.5)),
    ((-0.3, -1.2, 1.40), (-0.6, 0.4, 0.0)),
    ((0.1, -1.10, 1.40), (1.5, -0.2, 0.6)),
    ((0.5, -1.05, 1.40), (1.9, -1.6, 1.0)),
    ((0.7, -1.05, 1.40), (0.9, -2.0, 1.2)),
    ((1.0, -1.05, 1.40), (1.2, -2.0, 0.5)),
    ((1.5, -1.15, 1.45), (2.2, -1.7, 0.3)),
    ((1.2, -1.0, 1.50), (1.7, 0.4, 0.7)),
    ((0.7, -0.5, 1.50), (1.6, 0.5, 0.7)),
    ((0.5, 0.5, 1.45), (1.7, 0.6, 0.7)),
    ((0.6, 1.15, 1.45), (1.7, 0.5, 0.6)),
    ((1.0, 1.3, 1.50), (2.2, 1.4, 0.7)),
    ((0.6, 1.2, 1.40), (0.6, 0.0, 0.0)),
    ((0.3, 1.1, 1.40), (-0.9, 0.5, 0.4)),
    ((0.1, 1.0, 1.40), (-1.3, 1.5, 0.6)),
    ((-0.1, 0.9, 1.40), (-0.3, 1.95, 0.6)),
    ((-0.9, 1.2, 1.40), (-2.0, 1.4, 0.6)),
    ((-0.9, 1.1, 1.40), (-1.0, 0.2, 0.4)),
    # Once around the upper walls and the ceiling.
    ((-0.3, 0.5, 1.40), (-2.3, 0.5, 2.15)),
    ((0.0, -0.2, 1.40), (-1.0, 1.9, 2.30)),
    ((0.0, -0.7, 1.40), (0.8, 1.9, 2.35)),
    ((-0.5, -0.8, 1.40), (1.8, 0.4, 2.35)),
    ((-0.9, -0.1, 1.40), (1.6, -0.9, 2.40)),
    ((-0.3, 0.6, 1.40), (0.7, -1.9, 2.35)),
    ((0.4, 0.7, 1.45), (-0.6, -1.9, 2.35)),
    ((0.5, 0.3, 1.50), (-1.9, -1.1, 2.20)),
    ((0.2, -0.4, 1.50), (-2.3, 0.2, 1.40)),
]

_NOVEL = [
    ((1.0, -1.0, 1.65), (-1.5, 0.5, 0.8)),
    ((0.3, -1.1, 1.35), (-0.5, 1.8, 1.2)),
    ((-0.9, -1.1, 1.60), (1.2, 0.5, 0.8)),
    ((-1.4, -0.6, 1.65), (1.5, -0.3, 1.0)),
    ((-1.2, 0.4, 1.60), (1.0, -1.9, 1.2)),
    ((-1.0, 1.1, 1.65), (1.8, -0.5, 0.9)),
    ((-0.2, 1.25, 1.40), (-0.6, -1.9, 1.3)),
    ((0.6, 0.9, 1.65), (-1.8, -0.3, 0.8)),
    ((0.7, 0.2, 1.45), (-2.4, 1.0, 1.2)),
    ((0.2, -0.3, 1.30), (2.3, 0.6, 1.2)),
]

TRAJECTORIES = {"mapping": _MAPPING, "novel": _NOVEL}


def walk(
    trajectory: str, n_frames: int, seed: int, *, delay_s: float = 0.0
) -> tuple[ndarray, ndarray]:
    """Poses and times of a walk whose length in seconds does not depend on ``n_frames``.

    Args:
        trajectory: "mapping" (the whole room) or "novel" (another path, for views that were never
            mapped).
        n_frames: Number of frames, spread evenly over the walk.
        seed: Seed of the hand's tremor.
        delay_s: The poses are those of this much later; the camera rests at the end of the walk.

    Returns:
        ``T_WC`` [n, 4, 4] float64 and timestamps [n] without the delay, seconds.
    """
    from scipy.interpolate import PchipInterpolator

    eyes, targets = (
        _rounded(np.array(points)) for points in zip(*TRAJECTORIES[trajectory], strict=True)
    )
    knots = np.arange(len(eyes))
    # Monotone cubics do not overshoot a waypoint, so the path keeps its distance from the
    # furniture.
    path = PchipInterpolator(knots, np.concatenate([eyes, targets], 1))
    fine = np.linspace(0.0, knots[-1], 60 * len(knots))
    arrival = _pace(path(fine))
    times = np.linspace(0.0, arrival[-1], n_frames)
    at = times + delay_s
    eye, target = np.split(
        path(np.interp(at, arrival, fine)),
        2,
        axis=1,
    )
    rng = np.random.default_rng([seed, 4])
    eye += _tremor(at, 0.008, rng)
    target += _tremor(at, 0.02, rng)
    return np.stack([look_at(e, t) for e, t in zip(eye, target, strict=True)]), times


def look_at(eye_W: ndarray, target_W: ndarray) -> ndarray:
    """T_WC of an upright camera at ``eye_W`` that looks at ``target_W``. [4, 4]"""
    view_W = target_W - eye_W
    view_W = view_W / np.linalg.norm(view_W)
    right = np.cross(view_W, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    T = np.eye(4)
    T[:3, :3] = np.stack([right, np.cross(view_W, right), view_W], 1)
    T[:3, 3] = eye_W
    return T


def _pace(points: ndarray) -> ndarray:
    """Arrival times along finely sampled (eye, target) at a slow walking and turning speed,
    seconds. [n, 6] -> [n]"""
    eyes, targets = np.split(points, 2, axis=1)
    look = targets - eyes
    look /= np.linalg.norm(look, axis=1, keepdims=True)
    turn = np.linalg.norm(np.diff(look, axis=0), axis=1) / _TURN_RAD_S
    step = np.linalg.norm(np.diff(eyes, axis=0), axis=1) / _SPEED_M_S
    pace = np.convolve(
        np.pad(np.maximum(turn, step), 20, mode="edge"),
        np.ones(41) / 41,
        mode="valid",
    )
    return np.concatenate([[0.0], np.cumsum(pace)])


def _rounded(points: ndarray) -> ndarray:
    """Waypoints moved a little towards the middle of their neighbours."""
    path = points.copy()
    path[1:-1] = 0.7 * points[1:-1] + 0.15 * (points[:-2] + points[2:])
    return path


def _tremor(times: ndarray, size_m: float, rng: np.random.Generator) -> ndarray:
    """A few slow sines per axis. [n, 3]"""
    frequency = np.array([0.31, 0.57, 1.1])[:, None, None]
    phase = rng.uniform(0, 2 * np.pi, (3, 1, 3))
    weight = np.array([0.5, 0.35, 0.15])[:, None, None]
    return size_m * (weight * np.sin(2 * np.pi * frequency * times[None, :, None] + phase)).sum(0)


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


def disturbed_poses(
    T_WC: ndarray, times_s: ndarray, sigma_m: float, sigma_deg: float, seed: int
) -> ndarray:
    """Poses T_WC exp(xi) with an error xi that wanders: in each direction of the camera ``sigma_m``
    and ``sigma_deg``. [n, 4, 4]"""
    from scipy.spatial.transform import Rotation

    xi = wandering(times_s, 6, np.random.default_rng([seed, 5]))
    error = np.tile(np.eye(4), (len(T_WC), 1, 1))
    error[:, :3, :3] = Rotation.from_rotvec(np.radians(sigma_deg) * xi[:, 3:]).as_matrix()
    error[:, :3, 3] = sigma_m * xi[:, :3]
    return T_WC @ error


def exposure_gains(times_s: ndarray, sigma_stops: float, seed: int) -> ndarray:
    """Factors of red, green and blue of the linear light in each frame: the brightness wanders by
    ``sigma_stops``, each colour by a fifth of that on its own (white balance). [n, 3]"""
    wander = wandering(times_s, 4, np.random.default_rng([seed, 6]))
    return 2.0 ** (sigma_stops * (wander[:, :1] + 0.2 * wander[:, 1:]))


def exposed(rgb_u8: ndarray, gain: ndarray) -> ndarray:
    """The picture with another exposure: its light, colour ** 2.2, times ``gain``; what is too
    bright is white."""
    levels = np.clip(
        (np.arange(256) / 255.0)[:, None] * gain ** (1 / 2.2),
        0,
        1,
    )
    table = np.rint(255 * levels).astype(np.uint8)
    return np.stack(
        [table[rgb_u8[..., c], c] for c in range(3)],
        axis=-1,
    )


def without_depth(xyz_W: ndarray, share: float, seed: int) -> ndarray:
    """Which points lie in a cube of 40 cm whose surface gives no depth, seen from anywhere: this
    share of the cubes."""
    cube = np.floor(xyz_W / _CUBE_M).astype(np.int64) + 512
    chance = np.random.default_rng([seed, 7]).uniform(size=1 << 14)
    hash_code = (cube[..., 0] * 73856093) ^ (cube[..., 1] * 19349663) ^ (cube[..., 2] * 83492791)
    return chance[hash_code % len(chance)] < share
