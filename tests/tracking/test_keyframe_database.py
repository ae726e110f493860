"""Recognising database in the built-in room, whose poses are exact."""

import dataclasses

import pytest
import torch

from gsfusion_nb.data.room import room
from gsfusion_nb.export import CheckpointStore
from gsfusion_nb.geometry import se3
from gsfusion_nb.tracking.features import extract_features
from gsfusion_nb.tracking.keyframe_database import KeyframeDatabase


@pytest.fixture(scope="module")
def sequence():
    return room(n_frames=400, width=320, height=240)


@pytest.fixture(scope="module")
def known(sequence):
    """Every sixth frame of the first part of the walk."""
    database = KeyframeDatabase(sequence.camera)
    for i in range(0, 120, 6):
        database.add(i, sequence.pose(i), extract_features(sequence[i], count=1000, levels=8))
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
