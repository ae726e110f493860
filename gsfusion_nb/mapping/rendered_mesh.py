"""A mesh of a map that has no distance field: the depth that it renders, fused into a TSDF."""

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from ..config import TsdfConfig
from ..render import SurfaceView
from ..tsdf import TsdfVolume, extract_mesh, integrate
from ..types import Camera, Frame, Mesh

VIEWS = 60
"""Views whose rendered depth makes the mesh."""


def mesh_of_views(
    see: Callable[[Camera, Tensor], SurfaceView],
    camera: Camera | None,
    poses: Sequence[Tensor],
    config: TsdfConfig,
    device: torch.device,
) -> Mesh:
    """Surface of the depth that ``see`` renders from about ``VIEWS`` poses ``T_WC``, all along the trajectory.

    camera: Of the views; None if there are no poses.
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
