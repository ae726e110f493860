"""Which way is up in a map, and the rotation that turns the map upright for other programs."""

import math
from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from ..checks import check_name
from ..errors import ArgumentError

UP_AXES = {
    "+x": (0, 1.0),
    "-x": (0, -1.0),
    "+y": (1, 1.0),
    "-y": (1, -1.0),
    "+z": (2, 1.0),
    "-z": (2, -1.0),
}
"""Names of the directions along the axes, such as "-y"."""
_SNAP_DEG = 15.0
"""An estimated up direction within this angle of a world axis is replaced by that axis, degrees."""

Up = str | Float[Tensor, "3"] | Sequence[float]


def world_up(poses: Sequence[Float[Tensor, "4 4"]]) -> Float[Tensor, "3"]:
    """The up direction of the scene: the mean of the cameras' -y axes.

    Within 15 degrees of a world axis it is that axis; without poses it is z.
    """
    if not len(poses):
        return torch.tensor([0.0, 0.0, 1.0])
    mean = -torch.stack([T.detach().cpu().float()[:3, 1] for T in poses]).mean(0)
    if float(mean.norm()) < 1e-6:
        return torch.tensor([0.0, 0.0, 1.0])
    up = mean / mean.norm()
    axis = int(up.abs().argmax())
    if float(up[axis].abs()) >= math.cos(math.radians(_SNAP_DEG)):
        world_axis = torch.zeros(3)
        world_axis[axis] = float(up[axis].sign())
        return world_axis
    return up


def up_vector(up: Up) -> Float[Tensor, "3"]:
    """A direction given as "+z" or as three numbers, as a unit vector, float64.

    Raises:
        KeyError: no such axis. ValueError: not three finite numbers, or all are 0.
    """
    if isinstance(up, str):
        check_name("up axis", up, UP_AXES)
        axis, sign = UP_AXES[up]
        return torch.eye(3, dtype=torch.float64)[axis] * sign
    vector = torch.as_tensor(up, dtype=torch.float64).detach().cpu()
    if vector.shape != (3,) or not bool(vector.isfinite().all()) or not float(vector.norm()) > 1e-9:
        raise ArgumentError(f"up must be a direction of three numbers, got {vector.tolist()}")
    return vector / vector.norm()


def turn_to_y_up(up: Up) -> Float[Tensor, "3 3"]:
    """The rotation R with R up = +y, for glTF, float64.

    For the axes it is a change of axes without rounding: "-y" (the OpenCV axes of the first camera)
    is (x, y, z) -> (x, -y, -z), "+z" is (x, y, z) -> (x, z, -y).
    """
    u = up_vector(up)
    level = torch.eye(3, dtype=torch.float64)[2 if float(u[0].abs()) > 0.9 else 0]
    e1 = level - (level @ u) * u
    e1 = e1 / e1.norm()
    return torch.stack([e1, u, torch.linalg.cross(e1, u)]) + 0.0  # no negative zeros


def turn_to_minus_y_up(up: Up) -> Float[Tensor, "3 3"]:
    """The rotation R with R up = -y, which viewers of splat files expect, float64."""
    half_turn = torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64))
    return half_turn @ turn_to_y_up(up) + 0.0
