"""Fixtures of the whole suite: unwritten memory is NaN, real sequences are optional, the cache is a scratch folder."""

from pathlib import Path

import pytest
import torch

from gsfusion_nb.config import gsfusion
from gsfusion_nb.data import apply_options
from gsfusion_nb.data.room import room

SHARED_DATA = Path(__file__).resolve().parents[2] / "shared" / "data"


@pytest.fixture(autouse=True)
def _unwritten_memory_is_nan(monkeypatch):
    """``torch.empty`` and its relatives return NaN, so an output that is not written everywhere fails its test."""

    def poison(make):
        def filled(*args, **kwargs):
            out = make(*args, **kwargs)
            return out.fill_(float("nan")) if out.is_floating_point() and "out" not in kwargs else out

        return filled

    for name in ("empty", "empty_like", "empty_strided"):
        monkeypatch.setattr(torch, name, poison(getattr(torch, name)))


@pytest.fixture(autouse=True, scope="session")
def _scratch_cache(tmp_path_factory):
    """Anything the package caches on disk goes to a folder of this test session."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("GSFUSION_CACHE", str(tmp_path_factory.mktemp("cache")))
        yield


@pytest.fixture(autouse=True, scope="session")
def _one_thread():
    """Small tensors gain nothing from threads, and waiting threads slow each other down on a busy machine."""
    torch.set_num_threads(1)


@pytest.fixture(autouse=True)
def _own_rules(monkeypatch):
    """Seeding rules that a test registers end with it."""
    from gsfusion_nb.seeding import rule

    monkeypatch.setattr(rule, "_RULES", dict(rule._RULES))


@pytest.fixture
def generator():
    """Random numbers that repeat."""
    return torch.Generator().manual_seed(0)


@pytest.fixture
def shared_sequence():
    """``shared_sequence(name)`` is the folder of a real sequence, or skips the test with the reason."""

    def find(name: str) -> Path:
        folder = SHARED_DATA / name
        if not folder.is_dir():
            pytest.skip(f"real sequence {name!r} is not beside this checkout")
        return folder

    return find


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
