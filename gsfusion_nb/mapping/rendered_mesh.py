"""Mesh of a map without a distance field: its rendered depth is fused into a TSDF."""

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from ..config import TsdfConfig
from ..render import SurfaceView
from ..tsdf import TsdfVolume, extract_mesh, integrate
from ..types import Camera, Frame, Mesh

VIEWS = 60
"""Number of views whose rendered depth is fused to the mesh."""


def mesh_of_views(
    see: Callable[[Camera, Tensor], SurfaceView],
    camera: Camera | None,
    poses: Sequence[Tensor],
    config: TsdfConfig,
    device: torch.device,
) -> Mesh:
    """Surface of the map: depth rendered by ``see`` from about ``VIEWS`` poses ``T_WC`` along the trajectory, fused.

    ``camera`` is that of the views; it may be None if there are no poses.
    """
    volume = TsdfVolume(config, device=device)
    for index, T_WC in enumerate(poses[:: max(1, len(poses) // VIEWS)]):
        assert camera is not None
        view = see(camera, T_WC)
        frame = Frame(
            index=index,
            timestamp_s=0.0,
            rgb=view.rgb.clamp(0, 1),
            depth_m=view.depth_m,
            camera=camera,
            T_WC=T_WC.to(device),
        )
        integrate(volume, frame)
    return extract_mesh(volume)
