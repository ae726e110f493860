"""The local map in the built-in room, whose poses are exact."""

import pytest
import torch

from gsfusion_nb.data.room import room
from gsfusion_nb.export import CheckpointStore
from gsfusion_nb.geometry import se3
from gsfusion_nb.tracking.bundle_adjustment import adjust
from gsfusion_nb.tracking.features import extract_features
from gsfusion_nb.tracking.landmark_map import LandmarkMap
from gsfusion_nb.tracking.landmark_rows import landmark_sums

KEYFRAMES = range(30, 60, 6)


@pytest.fixture(scope="module")
def sequence():
    return room(n_frames=400, width=320, height=240)


@pytest.fixture(scope="module")
def views(sequence):
    return {i: extract_features(sequence[i], count=1000, levels=8) for i in (*KEYFRAMES, 57, 300)}


def mapped(sequence, views):
    known = LandmarkMap(sequence.camera)
    for i in KEYFRAMES:
        known.add(i, sequence.pose(i), views[i])
    return known


def seen_by(known, features, T_WC):
    seen = known.see(features, T_WC)
    assert seen is not None
    return seen


@pytest.fixture(scope="module")
def known(sequence, views):
    return mapped(sequence, views)


@pytest.mark.parametrize("twist", [[0, 0, 0, 0, 0, 0], [0.03, -0.02, 0.02, 0.02, -0.02, 0.03], [0, 0, 0, 0, 0.6, 0]])
def test_a_view_is_seen_from_a_wrong_prediction(known, sequence, views, assert_pose, twist):
    """The last one, 34 degrees off, predicts nearly nothing into the view: the last keyframe's match helps. Corners are
    found to a pixel, which is 1 cm at 2 m."""
    true = sequence.pose(57).double()
    seen = seen_by(known, views[57], true @ se3.exp(torch.tensor(twist, dtype=torch.float64)))
    assert_pose(seen.T_WC, true, 0.02, 0.4)
    assert len(seen.pairs) == len(seen.rows) > 100
    assert set(seen.pairs[:, 1]) <= set(seen.expected)


def test_landmarks_count_only_against_a_pose_that_they_contradict(known, sequence, views):
    seen = seen_by(known, views[57], sequence.pose(57))
    rows = seen.extra(0.02)
    near, far = (seen.T_WC @ se3.exp(torch.tensor([x, 0, 0, 0, 0, 0], dtype=torch.float64)) for x in (0.001, 0.2))
    assert not any(x.any() for x in rows(near))
    H, b = rows(far)
    every = landmark_sums(seen.rows, far)
    share = float(H.trace() / every.H.trace()) / 0.02**2
    assert 0.9 < share < 1
    torch.testing.assert_close(b, share * 0.02**2 * every.b)


def test_another_place_is_not_seen(known, sequence, views):
    assert known.see(views[300], sequence.pose(57)) is None


def test_keyframes_share_landmarks(known):
    for a, b in zip(range(4), range(1, 5), strict=True):
        assert len(known.landmarks.shared(a, b)) > 50
    assert known.around(known.database.T_WC[0])[0] == 0
    assert known.around(known.database.T_WC[4])[-3:] == [2, 3, 4]


def test_refined_landmarks_agree_better_with_all_views(sequence, views, known, monkeypatch):
    """Poses are exact, so what several views agree on is nearer to the truth than what the first one measured."""
    monkeypatch.setattr(LandmarkMap, "refine", lambda *_: None)
    first = mapped(sequence, views)
    held = torch.ones(len(KEYFRAMES), dtype=torch.bool)
    errors = []
    for m in (first, known):
        seen = m.landmarks.observations(per_keyframe=1000)
        errors.append(adjust(m.camera, torch.stack(m.database.T_WC), seen, [], held, iterations=0).error_before)
    assert errors[1] < 0.8 * errors[0]


def test_what_is_never_found_leaves_the_local_map(sequence, views):
    """After 20 views without any of them, none of the landmarks in view is searched for."""
    known = mapped(sequence, views)
    seen = seen_by(known, views[57], sequence.pose(57))
    for _ in range(20):
        known.landmarks.count_views(seen.expected, seen.pairs[:100, 1])
    known.collect()
    again = seen_by(known, views[57], sequence.pose(57))
    assert set(again.pairs[:, 1]) >= set(seen.pairs[:100, 1])
    assert set(again.expected) == set(seen.pairs[:100, 1])


def test_state_goes_on_where_it_was(known, sequence, views, tmp_path):
    store = CheckpointStore(tmp_path)
    store.save(known.state_dict())
    again = LandmarkMap(sequence.camera)
    again.load_state(store.load().state)
    one, two = (seen_by(m, views[57], sequence.pose(56)) for m in (known, again))
    assert (one.pairs == two.pairs).all()
    assert torch.equal(one.T_WC, two.T_WC)
    assert LandmarkMap(sequence.camera).see(views[57], sequence.pose(57)) is None
