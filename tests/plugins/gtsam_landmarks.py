"""GTSAM's bundle adjustment, as an independent witness of ``gsfusion_nb.tracking.bundle_adjustment``."""

from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from gsfusion_nb.tracking.features import DEPTH_SIGMA_PER_M
from gsfusion_nb.tracking.landmarks import Observations
from gsfusion_nb.tracking.pose_graph import Edge, Optimised, _between, _solve, _start, require_gtsam
from gsfusion_nb.types import Camera

SIGHTING_CAUCHY = 2.4
"""Larger errors of landmark observations, in standard deviations, get less weight (95 % efficiency)."""

_LANDMARK_KEYS = 10_000_000
"""Smaller keys are poses."""


def optimise_landmarks(
    camera: Camera,
    T_WC: Float[Tensor, "K 4 4"],
    seen: Observations,
    edges: list[Edge],
    *,
    iterations: int = 20,
) -> Optimised:
    """Poses and landmark positions that agree best with all observations and with ``edges``; the first pose is fixed.

    An observation with depth z counts as the stereo pair (u, u - f b / z, v) of a camera with baseline b = 1 m. Its
    covariance is s^2 for u and v and (f b 1.6e-3)^2 for the disparity, which is a depth error of 1.6e-3 z^2 at any z.
    An observation without depth counts as (u, v). Errors get Cauchy weights.

    Args:
        camera: Intrinsics of all keyframes.
        T_WC: Camera-to-world poses to start from. [K, 4, 4]
        seen: Observations, and the landmarks' starting positions.
        edges: Further relative poses, such as those of the front end.
        iterations: Largest number of steps.

    Raises:
        ImportError: without GTSAM.

    Differentiable: no.
    """
    gtsam = require_gtsam()
    graph, values = _start(gtsam, T_WC)
    for edge in edges:
        graph.add(_between(gtsam, edge))
    for landmark, xyz in enumerate(seen.xyz_W.numpy()):
        values.insert(_LANDMARK_KEYS + landmark, gtsam.Point3(xyz))
    _add_sightings(gtsam, graph, camera, seen)
    return _solve(gtsam, graph, values, len(T_WC), iterations)


def _add_sightings(gtsam: Any, graph: Any, camera: Camera, seen: Observations) -> None:
    stereo = gtsam.Cal3_S2Stereo(camera.fx, camera.fy, 0.0, camera.cx, camera.cy, 1.0)
    mono = gtsam.Cal3_S2(camera.fx, camera.fy, 0.0, camera.cx, camera.cy)
    disparity = torch.where(seen.depth_m > 0, camera.fx / seen.depth_m.clamp_min(1e-3), torch.zeros_like(seen.depth_m))
    models: dict[tuple[float, bool], Any] = {}
    rows = zip(
        seen.keyframe.tolist(),
        (seen.landmark + _LANDMARK_KEYS).tolist(),
        seen.uv.tolist(),
        disparity.tolist(),
        seen.sigma_px.tolist(),
        strict=True,
    )
    for pose, point, (u, v), d, sigma_px in rows:
        model = models.get((sigma_px, d > 0))
        if model is None:
            model = models[sigma_px, d > 0] = _sighting_noise(gtsam, camera, sigma_px, d > 0)
        if d > 0:
            measured = gtsam.StereoPoint2(u, u - d, v)
            graph.add(gtsam.GenericStereoFactor3D(measured, model, pose, point, stereo, False, False))
        else:
            uv = gtsam.Point2(u, v)
            graph.add(gtsam.GenericProjectionFactorCal3_S2(uv, model, pose, point, mono, False, False))


def _sighting_noise(gtsam: Any, camera: Camera, sigma_px: float, with_depth: bool) -> Any:
    """Noise of (u, u - d, v): the errors of u and d are independent, so the first two are correlated."""
    s2, d2 = sigma_px**2, (camera.fx * DEPTH_SIGMA_PER_M) ** 2
    covariance = np.array([[s2, s2, 0], [s2, s2 + d2, 0], [0, 0, s2]]) if with_depth else np.eye(2) * s2
    noise = gtsam.noiseModel.Gaussian.Covariance(covariance)
    return gtsam.noiseModel.Robust.Create(gtsam.noiseModel.mEstimator.Cauchy.Create(SIGHTING_CAUCHY), noise)
