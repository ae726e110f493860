"""Frames that are kept when they are read, within a limit of memory."""

import dataclasses

import pytest
import torch

from gsfusion_nb.data import FrameStore, FrameSubset, apply_options
from gsfusion_nb.types import Frame

FRAME_BYTES = 80 * 60 * (3 + 4)


class Counted:
    """A sequence that counts how often each frame is read."""

    def __init__(self, source):
        self.reads = []
        self.camera = source.camera
        self.name = "counted"
        self.source = source

    def __len__(self) -> int:
        return len(self.source)

    def __getitem__(self, i: int) -> Frame:
        self.reads.append(i)
        return self.source[i]

    def pose(self, i: int):
        return self.source.pose(i)


@pytest.fixture
def counted(small_room) -> Counted:
    return Counted(small_room)


def view(
    counted: Counted, store: FrameStore | None, positions: list[int] | None = None
) -> FrameSubset:
    positions = list(range(6)) if positions is None else positions
    return FrameSubset(source=counted, positions=positions, camera=counted.camera, kept=store)


def test_a_frame_that_is_kept_is_the_frame_that_was_read(counted):
    frames = view(counted, FrameStore(1 << 20))
    first = list(frames)
    second = list(frames)
    assert counted.reads == [*range(6)]
    for a, b, truth in zip(first, second, view(counted, None), strict=True):
        assert (a.index, a.timestamp_s, a.camera) == (b.index, b.timestamp_s, b.camera)
        for name in ("colour", "depth_m", "T_WC"):
            assert torch.equal(getattr(a, name), getattr(b, name))
            assert torch.equal(getattr(b, name), getattr(truth, name))


def test_colours_are_kept_as_bytes_and_what_others_do_to_a_frame_stays_there(counted):
    store = FrameStore(1 << 20)
    frame = view(counted, store)[0]
    before = frame.depth_m.clone()
    assert frame.rgb.dtype == torch.float32  # made now, and kept with this object
    frame.depth_m.zero_()
    kept = store.get(0)
    assert kept is not None
    assert kept.is_8_bit
    assert "rgb" not in vars(kept)
    assert torch.equal(kept.depth_m, before)
    assert store.n_bytes == FRAME_BYTES


def test_no_more_is_kept_than_the_limit(counted):
    store = FrameStore(3 * FRAME_BYTES)
    frames = view(counted, store)
    assert [f.index for f in frames] == [f.index for f in frames] == [*range(6)]
    assert counted.reads == [*range(6), 3, 4, 5]
    assert (len(store), store.n_bytes) == (3, 3 * FRAME_BYTES)


def test_wanted_frames_take_the_place_of_others(counted):
    store = FrameStore(3 * FRAME_BYTES)
    store.wanted = frozenset([1, 4, 5])
    list(view(counted, store))
    counted.reads.clear()
    assert [f.index for f in view(counted, store, [1, 4, 5])] == [1, 4, 5]
    assert counted.reads == []
    assert store.n_bytes == 3 * FRAME_BYTES


def test_a_frame_larger_than_the_limit_pushes_nothing_out(counted):
    store = FrameStore(FRAME_BYTES)
    small = dataclasses.replace(view(counted, None)[0])
    store.add(0, small)
    store.wanted = frozenset([1])
    large = dataclasses.replace(small, rgb=small.rgb.clone(), extra={})
    store.add(1, large)
    assert store.get(0) is not None
    assert store.get(1) is None


def test_further_images_are_made_again(counted):
    opened = apply_options(
        counted,
        extra=lambda frame: {"labels": torch.ones(60, 80, dtype=torch.int64)},
    )
    frames = opened.keeping(FrameStore(1 << 22)).mapping
    assert "labels" in frames[0].extra
    assert "labels" in frames[0].extra


def test_after_clear_frames_are_read_and_not_kept(counted):
    store = FrameStore(1 << 20)
    frames = view(counted, store)
    list(frames)
    store.clear()
    list(frames)
    assert counted.reads == [*range(6), *range(6)]
    assert (len(store), store.n_bytes) == (0, 0)
