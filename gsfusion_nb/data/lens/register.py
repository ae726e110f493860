"""Registering the depth image of one camera into the image of another."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ...geometry import depth_to_points, project, se3
from ...types import Camera
from .camera_model import CameraModel
from .undistort import Undistorter


def warp_depth(
    depth_m: Float[Tensor, "H W"], source: Camera, target: Camera, T_target_source: Float[Tensor, "4 4"]
) -> Float[Tensor, "h w"]:
    """Depth as ``target`` sees it: every point is moved to its pixel there; if several meet, the nearest is kept.

    One source pixel fills one target pixel, so the target may have holes where its resolution is higher; they are not
    filled.

    Args:
        depth_m: z-depth, metres, 0 = missing. [H, W]
        source: Camera of ``depth_m``.
        target: Camera to warp into.
        T_target_source: Rigid transform from the source camera's frame to the target camera's.

    Returns:
        z-depth in the target camera, metres, 0 = missing. [h, w]

    Differentiable: no.
    """
    P = se3.apply(T_target_source.to(depth_m.dtype), depth_to_points(source, depth_m)[depth_m > 0])
    P = P[P[:, 2] > 0]
    uv = project(target, P).floor().long()
    inside = (uv[:, 0] >= 0) & (uv[:, 0] < target.width) & (uv[:, 1] >= 0) & (uv[:, 1] < target.height)
    uv, z = uv[inside], P[inside, 2]
    out = torch.full((target.height * target.width,), torch.inf, dtype=depth_m.dtype, device=depth_m.device)
    out.scatter_reduce_(0, uv[:, 1] * target.width + uv[:, 0], z, reduce="amin")
    return out.where(out.isfinite(), torch.zeros_like(out)).reshape(target.height, target.width)


@dataclass(frozen=True, eq=False)
class Registration:
    """Makes a registered pair from a distorted colour image and a depth image of a second camera."""

    depth_camera: Camera
    colour: Undistorter
    T_colour_depth: Float[Tensor, "4 4"]

    @staticmethod
    def of(depth_camera: Camera, lens: CameraModel, T_depth_colour: Float[Tensor, "4 4"]) -> "Registration":
        """From the pose of the colour camera in the depth camera's frame."""
        return Registration(depth_camera, Undistorter(lens), se3.inverse(T_depth_colour))

    def __call__(self, rgb: np.ndarray, depth_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Undistorted colour, and depth warped into it."""
        rgb = self.colour.colour(rgb)
        warped = warp_depth(torch.from_numpy(depth_m), self.depth_camera, self.colour.camera, self.T_colour_depth)
        return rgb, warped.numpy()
