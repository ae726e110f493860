"""RTG-SLAM's map as files hold it: how its discs are drawn, and the mesh of what they show."""

import dataclasses
import itertools
import math
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ..config import RtgSlamConfig, TsdfConfig
from ..geometry import depth_to_points, se3
from ..render import render_forward, surface_depth_m, view_surface
from ..render.near_plane import near_plane_m
from ..tracking import SurfaceSource
from ..tsdf import TsdfVolume, extract_mesh, integrate
from ..types import Camera, Frame, GaussianParams, Mesh, RenderOutput
from .map_files import MapFiles
from .tracking_surface import surface_seen

MESH_VIEWS = 60
"""Fewest views whose rendered depth is fused to the mesh, if there are as many; a long walk has
more."""


class DiscFiles(MapFiles):
    """Files and pictures of a map of discs."""

    def constant_tensors(self) -> list[Tensor]:
        """Images of keyframes and of the window."""
        window = [image for f in self.mapper.window for image in (f.colour, f.depth_m)]
        return [*super().constant_tensors(), *window]

    @classmethod
    def render_gaussians(
        cls,
        params: GaussianParams,
        camera: Camera,
        T_WC: Float[Tensor, "4 4"],
        config: RtgSlamConfig,
    ) -> RenderOutput:
        """The map seen by a camera, with the depth of its discs as ``surface_depth_m``."""
        output, _ = render_forward(
            params,
            camera,
            T_WC,
            opaque_alpha=config.discs.opaque_alpha,
            near_m=near_plane_m(config),
        )
        depth_m = surface_depth_m(params, camera, T_WC, output, config.discs)
        return dataclasses.replace(output, surface_depth_m=depth_m)

    @classmethod
    def surface_from(cls, folder: Path, params: GaussianParams, config: Any) -> SurfaceSource:
        """The surface of the discs."""
        device = params.xyz_W.device
        return lambda camera, T_WC: surface_seen(
            view_surface(
                params, camera, T_WC.to(device), config.discs, near_m=near_plane_m(config)
            ),
            camera,
            T_WC,
        )


def disc_mesh(mapper: Any) -> tuple[Mesh, float]:
    """Surface of an RTG-SLAM map: depth rendered at poses along the trajectory, fused into a TSDF.

    The poses are spread evenly. Where the camera has turned by half of its field of view since the
    last one, or moved by half of the median depth in it, there is one more, so that neighbouring
    views overlap on any walk.

    Returns:
        The mesh, and the share of the surface seen halfway between the views whose voxels were
        observed.
    """
    config = mapper.config
    settings = TsdfConfig(
        voxel_size_m=config.mesh_voxel_m, truncation_voxels=4.0, near_m=near_plane_m(config)
    )
    volume = TsdfVolume(settings, device=mapper.device)
    poses = mapper.trajectory.poses
    camera = mapper.camera
    stride = max(1, len(poses) // MESH_VIEWS)
    fused_rows = []
    near = (0.0, 0.0)
    for row, T_WC in enumerate(poses):
        between_strides = row % stride and T_WC is not poses[-1]
        motion = se3.motion(poses[fused_rows[-1]], T_WC) if between_strides else near
        if motion[0] < near[0] and motion[1] < near[1]:
            continue
        view = mapper.surface(camera, T_WC)
        frame = Frame(
            index=row,
            timestamp_s=0.0,
            rgb=view.rgb.clamp(0, 1),
            depth_m=view.depth_m,
            camera=camera,
            T_WC=T_WC.to(mapper.device),
        )
        integrate(volume, frame)
        fused_rows.append(row)
        near = _nearness(camera, view.depth_m)
    middle_rows = [(a + b) // 2 for a, b in itertools.pairwise(fused_rows) if b - a > 1]
    some_rows = middle_rows[:: max(1, len(middle_rows) // 20)]
    observed = [_observed(volume, mapper, poses[row]) for row in some_rows]
    share = float(torch.cat(observed).float().mean()) if observed else 1.0
    return extract_mesh(volume), share


def _nearness(camera: Camera, depth_m: Float[Tensor, "h w"]) -> tuple[float, float]:
    """Half of the field of view, degrees, and half of the median depth, metres."""
    measured_m = depth_m[depth_m > 0]
    half_depth_m = 0.5 * float(measured_m.median()) if len(measured_m) else math.inf
    return math.degrees(math.atan(0.5 * camera.width / camera.fx)), half_depth_m


def _observed(volume: TsdfVolume, mapper: Any, T_WC: Float[Tensor, "4 4"]) -> Bool[Tensor, " N"]:
    """Whether the voxel of each surface point seen from a pose was observed; of every 16th pixel
    with depth."""
    depth_m = mapper.surface(mapper.camera, T_WC).depth_m
    xyz_W = se3.apply(T_WC.to(mapper.device), depth_to_points(mapper.camera, depth_m))
    return volume.sample_nearest(xyz_W[depth_m > 0][::16].contiguous()).W > 0
