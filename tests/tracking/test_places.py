"""places.npz: keyframes come back as they were, for any camera, and a file that is not in order is
refused by name."""

import dataclasses
from typing import Any

import numpy as np
import pytest
import torch

from gsfusion_nb.data.room import room
from gsfusion_nb.errors import SequenceError
from gsfusion_nb.tracking import KeyframeDatabase, Places, read_places, write_places


@pytest.fixture(scope="module")
def places():
    """Three keyframes of the built-in room."""
    source = room(n_frames=120, width=160, height=120)
    frames = [source[i] for i in (0, 4, 8)]
    database = KeyframeDatabase(source.camera)
    for frame in frames:
        database.add(frame.index, frame.T_WC, database.extract(frame))
    return Places.of(database)


def test_keyframes_come_back_bit_for_bit(places, tmp_path):
    path = tmp_path / "places.npz"
    write_places(path, places)
    stored = read_places(path)
    assert stored.camera == places.camera
    assert stored.index == places.index == [0, 4, 8]
    assert torch.equal(stored.T_WC, places.T_WC)
    assert sum(len(f) for f in stored.features) > 100
    for mine, theirs in zip(stored.features, places.features, strict=True):
        for name in ("uv", "descriptors", "has_depth", "sigma_px"):
            assert torch.equal(getattr(mine, name), getattr(theirs, name))
        assert torch.equal(mine.xyz_C[mine.has_depth], theirs.xyz_C[theirs.has_depth])


def test_no_keyframes_are_a_file_too(places, tmp_path):
    none = Places(camera=places.camera, index=[], T_WC=places.T_WC[:0], features=[])
    write_places(tmp_path / "places.npz", none)
    assert len(read_places(tmp_path / "places.npz")) == 0


def test_another_camera_sees_the_features_along_the_same_rays(places):
    camera = places.camera.resized(320, 240)
    seen = places.seen_by(camera)
    for mine, theirs in zip(seen.features, places.features, strict=True):
        assert torch.allclose(mine.uv, 2 * theirs.uv)
        assert torch.allclose(mine.sigma_px, 2 * theirs.sigma_px)
    database = KeyframeDatabase(camera)
    assert seen.landmark_map().camera == camera
    assert len(seen.landmark_map()) == 3
    assert len(database) == 0


CHANGES = {
    "index": lambda a: a * 0,
    "T_WC": lambda a: 2 * a,
    "n_features": lambda a: a + 1,
    "uv": lambda a: a - 1000,
    "descriptors": lambda a: a[:, :16],
    "xyz_C": lambda a: -a,
    "sigma_px": lambda a: 0 * a,
    "has_depth": lambda a: a.astype(np.uint8),
    "camera": lambda a: -a,
}


@pytest.mark.parametrize("name", CHANGES)
def test_a_wrong_array_is_refused_with_the_name_of_the_file(places, tmp_path, name):
    path = tmp_path / "places.npz"
    write_places(path, places)
    with np.load(path) as archive:
        arrays = dict(archive)
    for change in (CHANGES[name], lambda a: None, lambda a: np.full(a.shape, np.nan)):
        changed = change(arrays[name])
        others = {k: v for k, v in arrays.items() if k != name}
        arrays_now: dict[str, Any] = others if changed is None else others | {name: changed}
        np.savez_compressed(path, **arrays_now)
        with pytest.raises(SequenceError, match=r"places\.npz"):
            read_places(path)


def test_a_truncated_file_and_no_file(places, tmp_path):
    path = tmp_path / "places.npz"
    write_places(path, places)
    path.write_bytes(path.read_bytes()[:-200])
    with pytest.raises(SequenceError, match="truncated or damaged"):
        read_places(path)
    with pytest.raises(FileNotFoundError, match=r"none\.npz does not exist"):
        read_places(tmp_path / "none.npz")


def test_a_pose_that_was_refined_is_the_one_in_the_file(places):
    database = KeyframeDatabase(places.camera)
    for index, T_WC, features in zip(places.index, places.T_WC, places.features, strict=True):
        database.add(index, T_WC, features)
    moved = places.T_WC.clone()
    moved[:, 0, 3] += 1
    assert torch.equal(Places.of(database, moved).T_WC, moved)
    assert torch.equal(Places.of(database).T_WC, places.T_WC)
    assert dataclasses.replace(places, index=[1, 2, 3]).index == [1, 2, 3]
