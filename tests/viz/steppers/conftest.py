"""What the steppers of these tests step through: a volume, a small map, two frames."""

import itertools

import pytest
import torch

from gsfusion_nb.backends import use_backend
from gsfusion_nb.config import TsdfConfig
from gsfusion_nb.data.room import RoomSequence
from gsfusion_nb.tsdf import TsdfVolume, integrate


@pytest.fixture(scope="session")
def sequence():
    return RoomSequence(n_frames=120, width=48, height=36)


@pytest.fixture(scope="session")
def volume(sequence):
    volume = TsdfVolume(TsdfConfig(voxel_size_m=0.06, truncation_voxels=4.0))
    with use_backend("reference"):
        for i in (0, 1):
            integrate(volume, sequence[i])
    return volume


@pytest.fixture
def press():
    """Go to some steps of a stepper; each has a picture with something on it, a line, and an alt text.

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
        return [(step.title, {str(row[0]): row[-1] for row in step.numbers}) for step in stepper.steps]

    return through


@pytest.fixture(autouse=True)
def _one_thread():
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)
