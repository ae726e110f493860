"""Recognising database in the built-in room, whose poses are exact."""

import dataclasses

import pytest
import torch

from gsfusion_nb.data.room import room
from gsfusion_nb.export import CheckpointStore
from gsfusion_nb.geometry import se3
from gsfusion_nb.tracking.features import Features, extract_features
from gsfusion_nb.tracking.keyframe_database import KeyframeDatabase


@pytest.fixture(scope="module")
def sequence():
    return room(n_frames=400, width=320, height=240)


@pytest.fixture(scope="module")
def known(sequence):
    """Every sixth frame of the first part of the walk."""
    database = KeyframeDatabase(sequence.camera)
    for i in range(0, 120, 6):
        database.add(
            i,
            sequence.pose(i),
            extract_features(sequence[i], count=1000, levels=8),
        )
    return database


@pytest.mark.parametrize("i", [9, 33, 57, 81, 105])
def test_a_held_out_frame_is_found_without_a_prior(known, sequence, i):
    candidates = known.relocalise(sequence[i])
    assert candidates
    error = se3.inverse(sequence.pose(i).double()) @ candidates[0]
    assert float(error[:3, 3].norm()) < 0.03
    assert float(torch.rad2deg(se3.rotation_angle(error[:3, :3]))) < 2.0
    again = known.relocalise(extract_features(sequence[i], count=1000, levels=8))
    assert torch.equal(again[0], candidates[0])


def test_a_keyframe_is_most_similar_to_itself(known):
    rows = known.similar(known.features[7], 3)
    assert rows[0][0] == 7
    assert rows[0][1] == pytest.approx(1.0, abs=1e-4)
    assert rows[1][1] < 0.8
    assert [score for _, score in rows] == sorted((score for _, score in rows), reverse=True)


def test_an_unknown_view_is_not_found(known, sequence, generator):
    noise = torch.rand(240, 320, 3, generator=generator)
    assert known.relocalise(_with(sequence[0], noise)) == []
    assert known.relocalise(_with(sequence[0], torch.zeros(240, 320, 3))) == []


def test_state_survives_a_checkpoint(known, sequence, tmp_path):
    CheckpointStore(tmp_path).save(known.state_dict())
    other = KeyframeDatabase(sequence.camera)
    other.load_state(CheckpointStore(tmp_path).load().state)
    query = extract_features(sequence[45], count=1000, levels=8)
    assert other.similar(query, 5) == known.similar(query, 5)
    assert torch.equal(other.relocalise(query)[0], known.relocalise(query)[0])


def _with(frame, rgb):
    return dataclasses.replace(frame, rgb=rgb)


def no_features():
    return Features(
        uv=torch.zeros(0, 2),
        descriptors=torch.zeros((0, 32), dtype=torch.uint8),
        xyz_C=torch.zeros(0, 3),
        has_depth=torch.zeros(0, dtype=torch.bool),
        sigma_px=torch.zeros(0),
    )


def test_views_without_features_can_be_kept_and_asked_about(sequence):
    database = KeyframeDatabase(sequence.camera)
    assert database.relocalise(no_features()) == []
    database.add(0, torch.eye(4), no_features())
    assert database.similar(no_features(), 3) == []
    features = extract_features(sequence[0], count=300, levels=4)
    assert database.relocalise(features) == []
    database.add(1, sequence.pose(0), features)
    database.add(2, torch.eye(4), no_features())
    torch.testing.assert_close(
        database.relocalise(features)[0],
        sequence.pose(0).double(),
        atol=1e-4,
        rtol=0,
    )


def test_corrected_poses_move_what_is_found(known, sequence):
    database = KeyframeDatabase(sequence.camera)
    for row in range(3):
        database.add(
            known.index[row],
            known.T_WC[row],
            known.features[row],
        )
    shift = torch.eye(4, dtype=torch.float64)
    shift[0, 3] = 1.0
    before = database.relocalise(known.features[1])[0]
    database.move(shift @ torch.stack(database.T_WC))
    torch.testing.assert_close(database.relocalise(known.features[1])[0], shift @ before)
    with pytest.raises(ValueError, match="each of the 3 keyframes, got 1"):
        database.move(shift[None])


def test_the_nearest_view_follows_new_and_moved_keyframes(known):
    database = KeyframeDatabase(known.camera)

    def pose(x_m: float) -> torch.Tensor:
        T_WC = torch.eye(4, dtype=torch.float64)
        T_WC[0, 3] = x_m
        return T_WC

    for i, x_m in enumerate((0.0, 1.0)):
        database.add(i, pose(x_m), known.features[0])
    assert database.nearest_view(pose(1.8)) == 1
    database.add(2, pose(2.0), known.features[0])
    assert database.nearest_view(pose(1.8)) == 2
    assert database.nearest_view(pose(1.8), before=2) == 1
    database.move(torch.stack([pose(1.9), pose(0.0), pose(1.0)]))
    assert database.nearest_view(pose(1.8)) == 0


def test_another_camera_is_refused(known):
    with pytest.raises(ValueError, match="must come from the keyframes' camera"):
        known.relocalise(room(n_frames=2, width=160, height=120)[0])


def test_among_300_keyframes_the_copies_of_the_same_view_come_first(known):
    database = KeyframeDatabase(known.camera)
    for row in range(300):
        database.add(
            row,
            known.T_WC[row % len(known)],
            known.features[row % len(known)],
        )
    rows = database.similar(known.features[5], 16)
    copies = list(range(5, 300, len(known)))
    assert sorted(row for row, _ in rows[:-1]) == copies
    assert rows[-1][1] < 0.8 < rows[-2][1]
