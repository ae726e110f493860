"""Two walks through the room: smooth paths of a hand-held camera through waypoints, looking at moving targets."""

import numpy as np
from numpy import ndarray

_SPEED_M_S = 0.5
_TURN_RAD_S = np.radians(38.0)

_MAPPING = [
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
]  # fmt: skip

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
]  # fmt: skip

TRAJECTORIES = {"mapping": _MAPPING, "novel": _NOVEL}


def walk(trajectory: str, n_frames: int, seed: int, *, delay_s: float = 0.0) -> tuple[ndarray, ndarray]:
    """Poses and times of a walk whose length in seconds does not depend on ``n_frames``.

    Args:
        trajectory: "mapping" (the whole room) or "novel" (another path, for views that were never mapped).
        n_frames: Number of frames, spread evenly over the walk.
        seed: Seed of the hand's tremor.
        delay_s: The poses are those of this much later; the camera rests at the end of the walk.

    Returns:
        ``T_WC`` [n, 4, 4] float64 and timestamps [n] without the delay, seconds.
    """
    from scipy.interpolate import PchipInterpolator

    eyes, targets = (_rounded(np.array(points)) for points in zip(*TRAJECTORIES[trajectory], strict=True))
    knots = np.arange(len(eyes))
    # Monotone cubics do not overshoot a waypoint, so the path keeps its distance from the furniture.
    path = PchipInterpolator(knots, np.concatenate([eyes, targets], 1))
    fine = np.linspace(0.0, knots[-1], 60 * len(knots))
    arrival = _pace(path(fine))
    times = np.linspace(0.0, arrival[-1], n_frames)
    at = times + delay_s
    eye, target = np.split(path(np.interp(at, arrival, fine)), 2, axis=1)
    rng = np.random.default_rng([seed, 4])
    eye += _tremor(at, 0.008, rng)
    target += _tremor(at, 0.02, rng)
    return np.stack([look_at(e, t) for e, t in zip(eye, target, strict=True)]), times


def look_at(eye_W: ndarray, target_W: ndarray) -> ndarray:
    """T_WC of an upright camera at ``eye_W`` that looks at ``target_W``. [4, 4]"""
    forward = target_W - eye_W
    forward = forward / np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    T = np.eye(4)
    T[:3, :3] = np.stack([right, np.cross(forward, right), forward], 1)
    T[:3, 3] = eye_W
    return T


def _pace(points: ndarray) -> ndarray:
    """Arrival times along finely sampled (eye, target) at a slow walking and turning speed, seconds. [n, 6] -> [n]"""
    eyes, targets = np.split(points, 2, axis=1)
    look = targets - eyes
    look /= np.linalg.norm(look, axis=1, keepdims=True)
    turn = np.linalg.norm(np.diff(look, axis=0), axis=1) / _TURN_RAD_S
    step = np.linalg.norm(np.diff(eyes, axis=0), axis=1) / _SPEED_M_S
    pace = np.convolve(np.pad(np.maximum(turn, step), 20, mode="edge"), np.ones(41) / 41, mode="valid")
    return np.concatenate([[0.0], np.cumsum(pace)])


def _rounded(points: ndarray) -> ndarray:
    """Waypoints moved a little towards the middle of their neighbours."""
    out = points.copy()
    out[1:-1] = 0.7 * points[1:-1] + 0.15 * (points[:-2] + points[2:])
    return out


def _tremor(times: ndarray, size_m: float, rng: np.random.Generator) -> ndarray:
    """A few slow sines per axis. [n, 3]"""
    frequency = np.array([0.31, 0.57, 1.1])[:, None, None]
    phase = rng.uniform(0, 2 * np.pi, (3, 1, 3))
    weight = np.array([0.5, 0.35, 0.15])[:, None, None]
    return size_m * (weight * np.sin(2 * np.pi * frequency * times[None, :, None] + phase)).sum(0)
