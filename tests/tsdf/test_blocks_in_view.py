"""Which blocks a frame is fused into: those that the view may reach, and none beyond one of its
sides."""

import pytest
import torch

from gsfusion_nb.config import TsdfConfig
from gsfusion_nb.geometry import se3
from gsfusion_nb.tsdf.integrate import corners_in_view
from gsfusion_nb.types import Camera

CONFIG = TsdfConfig(voxel_size_m=0.02, truncation_voxels=4.0, far_m=3.0)
CAMERA = Camera(fx=100.0, fy=120.0, cx=70.0, cy=50.0, width=160, height=100)
"""Its centre is not in the middle, so the four sides lie at different angles."""
BLOCK_M = 0.16
POSES = {
    "at the origin": torch.eye(4),
    "elsewhere": se3.exp(torch.tensor([0.3, -0.2, 0.5, 0.4, -0.6, 0.2])).inverse(),
}


def block_at(u: float, v: float, z: float) -> torch.Tensor:
    """Corners of a block whose middle is at a pixel and a depth, camera frame, metres. [8, 3]"""
    middle = torch.tensor([(u - CAMERA.cx) / CAMERA.fx * z, (v - CAMERA.cy) / CAMERA.fy * z, z])
    signs = torch.cartesian_prod(*[torch.tensor([-0.5, 0.5])] * 3)
    return middle + signs * BLOCK_M


@pytest.mark.parametrize("pose", POSES)
@pytest.mark.parametrize(
    ("u", "v", "z", "expected"),
    [
        (70, 50, 2.0, True),
        (-3, 50, 2.0, True),  # its middle is outside, a corner is not: half a block has 4 px
        (-12, 50, 2.0, False),
        (163, 50, 2.0, True),
        (172, 50, 2.0, False),
        (70, -4, 2.0, True),
        (70, -12, 2.0, False),
        (70, 104, 2.0, True),
        (70, 112, 2.0, False),
        (70, 50, 0.05, True),  # around the camera
        (70, 50, -0.05, True),
        (70, 50, -0.1, False),
        (70, 50, 3.1, True),  # far_m and the truncation are 3.08 m
        (70, 50, 3.2, False),
        (230, 150, -2.0, False),  # behind the camera
    ],
)
def test_a_block_is_in_view_up_to_each_side(pose, u, v, z, expected):
    T_CW = POSES[pose]
    corners_W = se3.apply(T_CW.inverse(), block_at(u, v, z))[None]
    assert corners_in_view(corners_W, CONFIG, CAMERA, T_CW).tolist() == [expected]
