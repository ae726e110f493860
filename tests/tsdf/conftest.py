"""Analytic depth images and fields: a sphere, planes and the built-in room, seen by cameras that
are exact by construction. What is tested here is the reference; tests/kernels compare every other
backend with it."""

import pytest
import torch

from gsfusion_nb.backends import use_backend
from gsfusion_nb.config import TsdfConfig
from gsfusion_nb.data.room import RoomSequence
from gsfusion_nb.geometry import pixel_grid, rays
from gsfusion_nb.tsdf import TsdfVolume, integrate
from gsfusion_nb.tsdf.voxels import voxel_centres, voxels_of
from gsfusion_nb.types import Camera, Frame


@pytest.fixture(autouse=True)
def _on_the_reference():
    with use_backend("reference"):
        yield


@pytest.fixture
def camera():
    """Not square, and its principal point not in the middle."""
    return Camera(
        width=160,
        height=120,
        fx=140.0,
        fy=150.0,
        cx=83.0,
        cy=57.5,
    )


@pytest.fixture
def look_from():
    """``look_from(position, target)``: a camera-to-world pose, OpenCV axes."""

    def pose(position, target=(0.0, 0.0, 0.0)):
        position = torch.tensor(position).double()
        target = torch.tensor(target).double()
        z = torch.nn.functional.normalize(target - position, dim=0)
        up = torch.tensor([0.1, -1.0, 0.2]).double()
        x = torch.nn.functional.normalize(torch.linalg.cross(z, up), dim=0)
        T = torch.eye(4, dtype=torch.float64)
        T[:3, :3] = torch.stack([x, torch.linalg.cross(z, x), z], dim=1)
        T[:3, 3] = position
        return T.float()

    return pose


@pytest.fixture
def make_frame():
    """``make_frame(depth_m, camera, T_WC)``: a frame whose colour is the position in the image."""

    def frame(depth_m, camera, T_WC=None, rgb=None):
        if rgb is None:
            uv = pixel_grid(camera)
            rgb = torch.stack(
                [uv[..., 0] / camera.width, uv[..., 1] / camera.height, uv[..., 0] * 0 + 0.25],
                dim=-1,
            )
        T_WC = torch.eye(4) if T_WC is None else T_WC
        return Frame(
            index=0,
            timestamp_s=0.0,
            rgb=rgb,
            depth_m=depth_m,
            camera=camera,
            T_WC=T_WC,
        )

    return frame


@pytest.fixture
def sphere_depth():
    """``sphere_depth(camera, T_WC, centre, radius)``: z-depth of a sphere, 0 where the ray misses
    it."""

    def depth(camera, T_WC, centre=(0.0, 0.0, 0.0), radius=0.5):
        c = (torch.tensor(centre).double() - T_WC[:3, 3].double()) @ T_WC[:3, :3].double()
        d = rays(camera, pixel_grid(camera, dtype=torch.float64))
        a = (d * d).sum(-1)
        b = d @ c
        e = c @ c - radius**2
        disc = b * b - a * e
        return torch.where(
            disc > 0,
            (b - disc.clamp_min(0).sqrt()) / a,
            0.0,
        ).float()

    return depth


@pytest.fixture
def filled_volume():
    """``filled_volume(sdf, low, high, config)``: blocks of a box, D from a function of position,
    all observed."""

    def fill(sdf, low, high, config=None):
        volume = TsdfVolume(config or TsdfConfig(voxel_size_m=0.02, truncation_voxels=4.0))
        axes = [torch.arange(a, b) for a, b in zip(low, high, strict=True)]
        volume.add_blocks(torch.stack(torch.meshgrid(*axes, indexing="ij"), dim=-1).view(-1, 3))
        centres = voxel_centres(voxels_of(volume.block_coords), volume.config.voxel_size_m)
        volume.D[:] = (sdf(centres) / volume.config.truncation_m).clamp(-1, 1).to(torch.float32)
        volume.W[:] = 1.0
        volume.rgb_planes[:] = ((centres * 0.2 + 0.5).transpose(1, 2)).to(torch.float32)
        return volume

    return fill


@pytest.fixture(scope="session")
def room_volume():
    """The built-in room in voxels of 4 cm, from 10 depth images without noise; and the frames."""
    sequence = RoomSequence(n_frames=60, width=96, height=72)
    frames = [sequence[i] for i in range(0, 20, 2)]
    volume = TsdfVolume(TsdfConfig(voxel_size_m=0.04, truncation_voxels=3.0))
    with use_backend("reference"):
        for frame in frames:
            integrate(volume, frame)
    return volume, frames
