"""What the steppers of these tests step through: a frame of a wavy wall, and the volume that it was
fused into."""

import itertools

import pytest
import torch

from gsfusion_nb.backends import use_backend
from gsfusion_nb.config import TsdfConfig
from gsfusion_nb.tsdf import TsdfVolume, integrate
from gsfusion_nb.types import Camera, Frame


@pytest.fixture(scope="session")
def frame():
    """A wavy wall about 1.3 m away, striped in its middle."""
    camera = Camera(
        width=48,
        height=36,
        fx=40.0,
        fy=40.0,
        cx=24.0,
        cy=18.0,
    )
    v, u = torch.meshgrid(
        torch.arange(36.0),
        torch.arange(48.0),
        indexing="ij",
    )
    depth_m = 1.2 + 0.12 * torch.sin(u / 7) * torch.cos(v / 5) + 0.004 * u
    stripes = torch.where(
        (u - 24).abs() < 9,
        (u.long() // 3 % 2).float(),
        0.5,
    )
    rgb = torch.stack([stripes, 0.5 + 0 * u, v / 36], dim=2)
    return Frame(
        index=0,
        timestamp_s=0.0,
        rgb=rgb,
        depth_m=depth_m,
        camera=camera,
        T_WC=torch.eye(4),
    )


@pytest.fixture(scope="session")
def volume(frame):
    volume = TsdfVolume(TsdfConfig(voxel_size_m=0.05, truncation_voxels=4.0))
    with use_backend("reference"):
        integrate(volume, frame)
    return volume


@pytest.fixture
def press():
    """Go to some steps of a stepper; each has a picture with something on it, a line, and an alt
    text.

    Returns the titles and numbers of all steps.
    """

    def through(stepper):
        pictures = []
        for k in sorted({round(i * (stepper.count - 1) / 4) for i in range(5)}):
            assert stepper.go_to(k).step == k
            picture = stepper.picture()
            assert picture.shape[2] == 4
            assert 0 < (picture[..., 3] > 0).mean() <= 1
            assert "<mark>" in stepper.code
            assert f"step {k + 1} of {stepper.count}" in stepper.alt
            pictures.append(picture)
        assert any((a != b).any() for a, b in itertools.pairwise(pictures))
        return [
            (step.title, {str(row[0]): row[-1] for row in step.numbers}) for step in stepper.steps
        ]

    return through


@pytest.fixture(autouse=True)
def _one_thread():
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)
