"""Tracks of features: found again by projection, merged over loops, thinned out for the graph."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from gsfusion_nb.data.room import room
from gsfusion_nb.export import CheckpointStore
from gsfusion_nb.geometry import project, se3
from gsfusion_nb.tracking.features import Features, extract_features
from gsfusion_nb.tracking.keyframe_database import KeyframeDatabase
from gsfusion_nb.tracking.landmark_map import LandmarkMap
from gsfusion_nb.tracking.landmark_pose import landmark_sums
from gsfusion_nb.tracking.landmarks import CULL_VIEWS, NO_LANDMARK, Landmarks
from gsfusion_nb.tracking.matching import hamming
from gsfusion_nb.types import Camera

CAMERA = Camera(
    width=320,
    height=240,
    fx=208.0,
    fy=208.0,
    cx=160.0,
    cy=120.0,
)


def seen(T_WC, xyz_W, descriptors, has_depth=None):
    xyz_C = se3.apply(se3.inverse(T_WC), xyz_W)
    known = torch.ones(len(xyz_W), dtype=torch.bool) if has_depth is None else has_depth
    return Features(
        uv=project(CAMERA, xyz_C).float(),
        descriptors=descriptors,
        xyz_C=(xyz_C * known[:, None]).float(),
        has_depth=known,
        sigma_px=torch.ones(len(xyz_W)),
    )


@pytest.fixture
def points(generator):
    xyz_W = torch.rand(40, 3, generator=generator, dtype=torch.float64) * 2 + torch.tensor(
        [-1.0, -1.0, 2.0]
    )
    return xyz_W, torch.randint(
        0,
        256,
        (40, 32),
        generator=generator,
        dtype=torch.uint8,
    )


def moved(x):
    T = torch.eye(4, dtype=torch.float64)
    T[0, 3] = x
    return T


def landmarks_of(*views):
    landmarks = Landmarks(KeyframeDatabase(CAMERA))
    for index, (T_WC, features, pairs) in enumerate(views):
        landmarks.database.add(index, T_WC, features)
        landmarks.add(features, pairs)
    return landmarks


NO_PAIRS = torch.zeros((0, 2), dtype=torch.int64)


def test_exact_points_are_found_where_they_project(points):
    xyz_W, descriptors = points
    first = landmarks_of((moved(0.0), seen(moved(0.0), xyz_W, descriptors), NO_PAIRS))
    order = torch.arange(39, -1, -1)
    again = seen(moved(0.2), xyz_W[order], descriptors[order])
    pairs = first.find(again, moved(0.2), [0], 5.0)
    assert pairs.tolist() == [[k, 39 - k] for k in range(40)]
    assert len(first.find(again, moved(0.8), [0], 5.0)) < 5
    assert first.find(again, moved(0.2), [], 5.0).shape == (0, 2)


def three_views(points):
    """Views 0 and 1 share landmarks 0-39; view 2 sees the same points but does not know it."""
    xyz_W, descriptors = points
    T = [moved(0.0), moved(0.1), moved(0.2)]
    known = torch.stack([torch.arange(40)] * 2, 1)
    views = [seen(t, xyz_W, descriptors) for t in T]
    return landmarks_of(
        (T[0], views[0], NO_PAIRS),
        (T[1], views[1], known),
        (T[2], views[2], NO_PAIRS),
    )


def test_observations_and_loops(points):
    landmarks = three_views(points)
    table = landmarks.observations(per_keyframe=100)
    assert len(table) == 80
    assert sorted(set(table.keyframe.tolist())) == [0, 1]
    loop = (2, torch.stack([torch.arange(10), torch.arange(10)], 1))
    landmarks.fuse([loop])
    joined = landmarks.observations(per_keyframe=100)
    assert len(joined) == 90
    assert int((joined.keyframe == 2).sum()) == 10
    assert len(joined.xyz_W) == 40
    T_CW = torch.stack([se3.inverse(T) for T in landmarks.database.T_WC])[joined.keyframe]
    xyz_C = (T_CW[:, :3, :3] @ joined.xyz_W[joined.landmark][:, :, None])[:, :, 0] + T_CW[:, :3, 3]
    torch.testing.assert_close(
        project(CAMERA, xyz_C),
        joined.uv,
        atol=1e-3,
        rtol=0,
    )
    torch.testing.assert_close(
        xyz_C[:, 2],
        joined.depth_m,
        atol=1e-5,
        rtol=0,
    )


def test_refined_positions_move_with_their_keyframe(points):
    landmarks = three_views(points)
    better = points[0][:5] + 0.02
    better[4] = float("nan")
    landmarks.refine(torch.arange(40, 45), better)  # born in the last view
    torch.testing.assert_close(landmarks.positions(torch.arange(40, 44)), better[:4])
    torch.testing.assert_close(
        landmarks.positions(torch.tensor([44])),
        points[0][4:5],
        atol=1e-6,
        rtol=0,
    )
    landmarks.database.move(torch.stack([moved(0.0), moved(0.1), moved(1.2)]))
    shift = torch.tensor([1.0, 0, 0], dtype=torch.float64)
    torch.testing.assert_close(landmarks.positions(torch.arange(40, 44)), better[:4] + shift)


def test_a_loop_makes_one_landmark_of_two(points):
    """The older name stays, in every keyframe; a feature that would double it in its keyframe has
    none."""
    landmarks = three_views(points)
    landmarks.fuse([(2, torch.tensor([[0, 0], [1, 1], [2, 1]]))])
    assert landmarks.of_feature[2][:4].tolist() == [0, 1, -1, 43]
    assert landmarks.shared(2, 1).tolist() == [[0, 0], [1, 1]]
    assert landmarks.of_feature[0].tolist() == list(range(40))


KEYFRAMES = range(30, 60, 6)


@pytest.fixture(scope="module")
def sequence():
    return room(n_frames=400, width=320, height=240)


@pytest.fixture(scope="module")
def views(sequence):
    return {
        i: extract_features(sequence[i], count=1000, levels=8) for i in (*KEYFRAMES, 51, 57, 300)
    }


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


@pytest.mark.parametrize(
    "twist",
    [[0, 0, 0, 0, 0, 0], [0.03, -0.02, 0.02, 0.02, -0.02, 0.03], [0, 0, 0, 0, 0.6, 0]],
)
def test_a_view_is_seen_from_a_wrong_prediction(known, sequence, views, assert_pose, twist):
    """The last one, 34 degrees off, predicts nearly nothing into the view: the last keyframe's
    match helps. Corners are found to a pixel, which is 1 cm at 2 m."""
    true = sequence.pose(57).double()
    seen = seen_by(
        known,
        views[57],
        true @ se3.exp(torch.tensor(twist, dtype=torch.float64)),
    )
    assert_pose(seen.T_WC, true, 0.02, 0.4)
    assert len(seen.pairs) == len(seen.rows) > 100
    assert set(seen.pairs[:, 1]) <= set(seen.expected)


def test_where_the_prediction_fails_the_last_keyframe_is_matched(
    known, sequence, views, monkeypatch
):
    asked = []
    compare = known.database.compare

    def asked_for(features, keyframe):
        asked.append(range(len(known))[keyframe])
        return compare(features, keyframe)

    monkeypatch.setattr(known.database, "compare", asked_for)
    turned = se3.exp(torch.tensor([0, 0, 0, 0, 0.6, 0], dtype=torch.float64))
    assert known.see(views[57], sequence.pose(57).double() @ turned) is not None
    assert asked == [len(known) - 1]


def test_landmarks_of_several_keyframes_confirm_what_one_cannot(
    known, views, sequence, assert_pose
):
    """With 80 corners one keyframe has too few matches to be believed."""
    some = torch.randperm(len(views[51]), generator=torch.Generator().manual_seed(1))[:80]
    few = views[51][some]
    assert known.database.relocalise(few) == []
    best, *_ = known.relocalise(few)
    assert len(best.pairs) >= 20
    assert_pose(best.T_WC, sequence.pose(51).double(), 0.05, 1.0)
    assert known.relocalise(views[300]) == []


def test_landmarks_count_only_against_a_pose_that_they_contradict(known, sequence, views):
    seen = seen_by(known, views[57], sequence.pose(57))
    rows = seen.extra
    near, far = (
        seen.T_WC @ se3.exp(torch.tensor([x, 0, 0, 0, 0, 0], dtype=torch.float64))
        for x in (0.001, 0.2)
    )
    assert not any(x.any() for x in rows(near))
    H, b = rows(far)
    every = landmark_sums(seen.rows, far)
    share = float(H.trace() / every.H.trace()) / 0.02**2
    assert 0.9 < share < 1
    torch.testing.assert_close(b, share * 0.02**2 * every.b)


def test_state_goes_on_where_it_was(known, sequence, views, tmp_path):
    store = CheckpointStore(tmp_path)
    store.save(known.state_dict())
    again = LandmarkMap(sequence.camera)
    again.load_state(store.load().state)
    one, two = (seen_by(m, views[57], sequence.pose(56)) for m in (known, again))
    assert (one.pairs == two.pairs).all()
    assert torch.equal(one.T_WC, two.T_WC)
    assert LandmarkMap(sequence.camera).see(views[57], sequence.pose(57)) is None


def test_a_lookalike_beside_it_is_not_guessed(points):
    """The same descriptor twice within reach: the ratio test drops the landmark."""
    xyz_W, descriptors = points
    first = landmarks_of((moved(0.0), seen(moved(0.0), xyz_W[:2], descriptors[:2]), NO_PAIRS))
    twice = torch.cat([xyz_W[:2], xyz_W[:1] + 0.01])
    again = seen(moved(0.0), twice, descriptors[[0, 1, 0]])
    assert first.find(again, moved(0.0), [0], 8.0).tolist() == [[1, 1]]


def test_new_landmarks_need_depth(points):
    xyz_W, descriptors = points
    has_depth = torch.arange(40) % 2 == 0
    landmarks = landmarks_of(
        (moved(0.0), seen(moved(0.0), xyz_W, descriptors, has_depth), NO_PAIRS)
    )
    assert len(landmarks) == 20
    assert (landmarks.of_feature[0][1::2] == -1).all()
    torch.testing.assert_close(
        landmarks.positions(torch.arange(20)),
        xyz_W[::2],
        atol=1e-6,
        rtol=0,
    )


def test_shared_landmarks(points):
    landmarks = three_views(points)
    assert len(landmarks) == 80
    assert landmarks.shared(1, 0).tolist() == [[k, k] for k in range(40)]
    assert landmarks.shared(2, 0).shape == (0, 2)


def test_the_longest_tracks_are_kept(points):
    loop = (2, torch.stack([torch.arange(10), torch.arange(10)], 1))
    landmarks = three_views(points)
    landmarks.fuse([loop])
    table = landmarks.observations(per_keyframe=10)
    assert len(table.xyz_W) == 10
    assert len(table) == 30


def test_nothing_to_observe():
    empty = landmarks_of(
        (
            moved(0.0),
            seen(
                moved(0.0),
                torch.zeros(0, 3).double(),
                torch.zeros((0, 32), dtype=torch.uint8),
            ),
            NO_PAIRS,
        )
    )
    assert len(empty) == 0
    assert len(empty.observations(per_keyframe=10)) == 0
    assert len(Landmarks(KeyframeDatabase(CAMERA)).observations(per_keyframe=10)) == 0


def test_landmarks_move_with_the_keyframe_they_were_born_in(points):
    landmarks = three_views(points)
    before = landmarks.positions(torch.tensor([3, 50]))
    landmarks.database.move(torch.stack([moved(0.0), moved(0.1), moved(1.2)]))
    after = landmarks.positions(torch.tensor([3, 50]))
    torch.testing.assert_close(
        after - before,
        torch.tensor([[0.0, 0, 0], [1, 0, 0]], dtype=torch.float64),
    )


def test_what_is_looked_for_in_vain_is_no_longer_looked_for(points):
    landmarks = three_views(points)
    everything = np.arange(80)
    never = 3
    rarely = 7
    for k in range(CULL_VIEWS):
        assert landmarks.is_good(everything).all()
        landmarks.count_views(
            np.array([never, rarely, 50]),
            np.array([rarely, 50] if k == 0 else [50]),
        )
    assert np.flatnonzero(~landmarks.is_good(everything)).tolist() == [never]
    for _ in range(CULL_VIEWS):  # found once in 30 times: less than 5 %
        landmarks.count_views(np.array([rarely]), np.array([], int))
    assert np.flatnonzero(~landmarks.is_good(everything)).tolist() == [never, rarely]


def test_neighbours_are_the_keyframes_that_share_most():
    """Of nine, seven; the one that shares 14 is none."""
    shared = [15, 20, 14, 40, 30, 15, 16, 17, 18]
    of_feature = [np.where(np.arange(40) < n, np.arange(40), NO_LANDMARK) for n in shared]
    last = np.append(np.arange(40), NO_LANDMARK)
    known = SimpleNamespace(landmarks=Counted(of_feature=[*of_feature, last]))
    assert LandmarkMap._covisible(known, 9, 9) == [3, 4, 1, 8, 7, 6, 0]  # type: ignore[arg-type]
    assert LandmarkMap._covisible(known, 9, 3) == [1, 0]  # type: ignore[arg-type]


class Counted(SimpleNamespace):
    """40 landmarks."""

    def __len__(self):
        return 40


def test_bits_are_counted(points):
    a, b = (x.numpy() for x in (points[1][:20], points[1][20:]))
    differing = [int(np.unpackbits(x ^ y).sum()) for x, y in zip(a, b, strict=True)]
    assert hamming(a, b).tolist() == differing


def test_keyframes_share_landmarks(known):
    for a, b in zip(range(4), range(1, 5), strict=True):
        assert len(known.landmarks.shared(a, b)) > 50
    assert known.around(known.database.T_WC[0])[0] == 0
    assert known.around(known.database.T_WC[4])[-3:] == [2, 3, 4]
