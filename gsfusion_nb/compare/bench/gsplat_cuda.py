"""gsplat's CUDA rasteriser, for comparison on a GPU; it is compiled with nvcc on first use."""

import importlib

import torch
from torch import Tensor

from ...constants import NEAR_PLANE_M, SCREEN_BLUR_PX2
from ...geometry import se3
from ...types import GaussianParams
from .scene import RandomScene


def is_built(module: object) -> bool:
    """Whether there is a GPU, and gsplat has kernels for it or can compile them."""
    if not torch.cuda.is_available():
        return False
    try:
        return importlib.import_module("gsplat.cuda._backend")._C is not None
    except (ImportError, RuntimeError, OSError):
        return False


def render(params: GaussianParams, scene: RandomScene) -> Tensor:
    """The picture. [H, W, 3] Differentiable: yes, by autograd."""
    from gsplat import rasterization  # pyright: ignore[reportMissingImports]

    camera = scene.camera
    picture, _, _ = rasterization(
        means=params.xyz_W,
        quats=params.quat,
        scales=params.log_scale.exp(),
        opacities=params.opacity_logit.sigmoid(),
        colors=params.sh,
        viewmats=se3.inverse(scene.T_WC)[None],
        Ks=camera.K.to(params.xyz_W)[None],
        width=camera.width,
        height=camera.height,
        near_plane=NEAR_PLANE_M,
        eps2d=SCREEN_BLUR_PX2,
        sh_degree=params.sh_degree,
        packed=False,
    )
    return picture[0]
