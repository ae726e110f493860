"""A short walk through the built-in room, small enough to be mapped in a second."""

import pytest

from gsfusion_nb.config import gsfusion
from gsfusion_nb.datasets import apply_options
from gsfusion_nb.datasets.room import room

SMALL = {
    "tsdf__voxel_size_m": 0.04,
    "tsdf__truncation_voxels": 4.0,
    "sh_degree": 1,
    "seeding__quadtree_threshold": 0.01,
    "data__hold_out_offset": 2,
    "data__hold_out_every": 4,
    "keyframe_min_seeds": 20,
    "optim__global_iterations": 2,
}


@pytest.fixture(scope="session")
def small_room():
    """Twelve frames of 80x60."""
    return room(n_frames=120, width=80, height=60)


@pytest.fixture
def config():
    """Coarse settings for small pictures."""
    return gsfusion("replica", **SMALL, data__stop=12)


@pytest.fixture
def split(small_room, config):
    """The walk, parted into frames to map and frames held out."""
    return apply_options(small_room, config.data)
