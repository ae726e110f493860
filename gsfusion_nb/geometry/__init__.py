"""Cameras, rigid transforms, quaternions, normals, spherical harmonics."""

import torch
from jaxtyping import Float
from torch import Tensor

from . import quaternion as quaternion
from . import se3 as se3
from .camera import backproject as backproject
from .camera import depth_to_normals as depth_to_normals
from .camera import depth_to_points as depth_to_points
from .camera import normals_at as normals_at
from .camera import pixel_grid as pixel_grid
from .camera import project as project
from .camera import rays as rays


def sum_rows(x: Float[Tensor, "N *W"]) -> Float[Tensor, "*W"]:
    """Sum over the first axis, always in the same order.

    torch adds up a long tensor in as many parts as there are threads, and rounds differently for
    each number of them. numpy uses one thread.

    Differentiable: no.
    """
    return (
        x.sum(0)
        if x.device.type != "cpu"
        else torch.as_tensor(
            x.detach().numpy().sum(axis=0),
            dtype=x.dtype,
        )
    )
