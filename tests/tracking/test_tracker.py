"""Tracking over several frames: prediction, judgement, loss and recovery."""

import dataclasses
import io

import pytest
import torch

from gsfusion_nb.config import TrackingConfig, TsdfConfig
from gsfusion_nb.data import open_sequence
from gsfusion_nb.evaluation import ate_rmse
from gsfusion_nb.geometry import se3
from gsfusion_nb.tracking import Tracker, TrackingLostError, icp, tsdf_surface
from gsfusion_nb.tracking.attempt import Attempt, Sight, Start, best_of
from gsfusion_nb.tsdf import TsdfVolume, integrate

VELOCITY = torch.tensor([0.02, 0.0, 0.01, 0.0, 0.02, 0.01]).double()


def path(n, start=0):
    return [se3.exp(VELOCITY * k) for k in range(start, start + n)]


def track_all(tracker, scene, poses, times=None):
    times = times or range(len(poses))
    return [
        tracker.track(scene.frame(T, i, float(t)), scene)
        for i, (T, t) in enumerate(zip(poses, times, strict=True))
    ]


def test_a_steady_motion_is_followed(plane_scene, assert_pose):
    reports = track_all(tracker := Tracker(), plane_scene("corner"), path(8))
    assert [r.status for r in reports] == ["first"] + ["ok"] * 7
    for report, T in zip(reports, path(8), strict=True):
        assert_pose(report.T_WC, T, 5e-4, 0.03)
        assert report.T_WC.dtype == torch.float32
    last = reports[-1].icp
    assert last is not None
    assert last.inlier_share > 0.9
    assert last.overlap_inlier_share > 0.9
    assert len(last.history) > 0
    assert tracker.lost_in_a_row == 0


def test_the_first_pose_is_the_datas_and_no_other(plane_scene, assert_pose):
    scene = plane_scene("corner")
    tracker = Tracker()
    first = scene.frame(path(1)[0])
    assert torch.equal(tracker.track(first, scene).T_WC, first.T_WC)
    nonsense = dataclasses.replace(
        scene.frame(path(2)[1], 1),
        T_WC=torch.zeros(4, 4),
    )
    assert_pose(
        tracker.track(nonsense, scene).T_WC,
        path(2)[1],
        5e-4,
        0.03,
    )


def test_prediction_carries_the_motion_on_in_proportion_to_time(plane_scene, assert_pose):
    tracker = Tracker()
    with pytest.raises(ValueError, match="before the first frame"):
        tracker.predict(0.0)
    track_all(tracker, plane_scene("corner"), path(3), times=[0.0, 0.1, 0.2])
    for ahead, motions in ((0.1, 1), (0.2, 2), (0.0, 1), (10.0, 4)):
        assert_pose(
            tracker.predict(0.2 + ahead),
            se3.exp((2 + motions) * VELOCITY),
            4e-3,
            0.3,
        )
    still = Tracker(TrackingConfig(prior="previous"))
    track_all(still, plane_scene("corner"), path(3))
    assert_pose(still.predict(9.0), path(3)[2], 5e-4, 0.03)


def test_the_landmarks_pose_is_tried_first(plane_scene, assert_pose):
    """A jump that no prediction reaches; a wrong guess does no harm."""
    jump = path(3)[2] @ se3.exp(torch.tensor([0.2, -0.15, 0.1, 0.2, 0.2, -0.1]).double())
    scene = plane_scene("corner")
    tracker = Tracker()
    track_all(tracker, scene, path(3))
    before = tracker.standing
    report = tracker.track(scene.frame(jump, 3), scene, guess=jump)
    assert (report.status, report.start) == ("ok", "the landmarks")
    assert_pose(report.T_WC, jump, 5e-4, 0.03)
    tracker.standing = before
    report = tracker.track(
        scene.frame(path(4)[3], 3),
        scene,
        guess=se3.exp(5 * VELOCITY) @ jump,
    )
    assert (report.status, report.start) == ("recovered", "the predicted pose")
    assert_pose(report.T_WC, path(4)[3], 5e-4, 0.03)


def test_along_an_edge_the_prediction_decides(plane_scene):
    """Nothing shows the motion along y; the two first poses say 2 cm per frame."""
    steps = [torch.eye(4).double() for _ in range(4)]
    for k, T in enumerate(steps):
        T[1, 3] = 0.02 * k
        T[2, 3] = 0.01 * k
    scene = plane_scene("edge")
    tracker = Tracker()
    track_all(tracker, scene, steps[:2])
    # the start knew no motion
    assert float(tracker.predict(2.0)[1, 3]) == pytest.approx(0.0, abs=2e-3)
    report = tracker.track(scene.frame(steps[2], 2), scene)
    assert report.icp is not None
    assert (report.status, report.icp.degenerate) == ("degenerate", 1)
    assert float(report.T_WC[2, 3]) == pytest.approx(0.02, abs=1e-3)
    assert float(report.T_WC[1, 3]) == pytest.approx(0.0, abs=2e-3)


def test_a_jump_is_lost_and_found_when_the_stream_returns(plane_scene, assert_pose):
    corner = plane_scene("corner")
    other = plane_scene("wall")
    tracker = Tracker()
    track_all(tracker, corner, path(4))
    elsewhere = torch.eye(4).double()
    elsewhere[2, 3] = 1.0
    for i in range(3):
        with pytest.raises(
            TrackingLostError,
            match=r"frame 1\d cannot be tracked: from the .* pose .*%.*wide limits",
        ):
            tracker.track(other.frame(elsewhere, 10 + i), corner)
    assert tracker.lost_in_a_row == 3
    back = path(1, start=5)[0]
    report = tracker.track(corner.frame(back, 20), corner)
    assert (report.status, report.start) == ("ok", "the last pose")
    assert_pose(report.T_WC, back, 5e-4, 0.03)
    assert tracker.lost_in_a_row == 0
    assert_pose(tracker.predict(21.0), report.T_WC, 1e-6, 1e-3)  # no velocity across a gap


class KnownPoses:
    """Knows one pose, behind a wrong one."""

    def __init__(self, *poses):
        self.poses = list(poses)
        self.asked = []

    def __call__(self, frame):
        self.asked.append(frame.index)
        return [(pose, None) for pose in self.poses]


def test_poses_by_appearance_are_tried_last_and_judged_by_their_fit(plane_scene, assert_pose):
    rolled = se3.exp(torch.tensor([0.1, 0.0, 0.1, 0.0, 0.0, 1.8]).double())
    known = KnownPoses(
        se3.exp(torch.tensor([9.0, 0, 0, 0, 3, 0]).double()),
        rolled,
    )
    corner = plane_scene("corner")
    tracker = Tracker()
    track_all(tracker, corner, path(3))
    assert known.asked == []
    there = se3.exp(torch.tensor([0.01, 0.02, 0.0, 0.0, 0.01, 0.02]).double()) @ rolled
    report = tracker.track(corner.frame(there, 9), corner, known)
    assert known.asked == [9]
    assert (report.status, report.start) == ("recovered", "place 2")
    assert_pose(report.T_WC, there, 1e-3, 0.05)
    assert_pose(tracker.predict(10.0), report.T_WC, 1e-6, 1e-3)
    follow = se3.exp(VELOCITY) @ there
    assert tracker.track(corner.frame(follow, 10), corner).status == "ok"


def test_correct_moves_the_end_of_the_path(plane_scene, assert_pose):
    tracker = Tracker()
    track_all(tracker, plane_scene("corner"), path(3))
    before = tracker.predict(3.0)
    change = se3.exp(torch.tensor([1.0, 2.0, 3.0, 0.5, 0.0, 0.1]))
    tracker.correct(change)
    assert_pose(tracker.predict(3.0), change.double() @ before, 1e-6, 1e-4)
    with pytest.raises(ValueError, match="T_change must be rigid"):
        tracker.correct(2 * torch.eye(4))


def test_correct_moves_the_frame_that_a_hybrid_target_is_mixed_with(plane_scene, assert_pose):
    scene = plane_scene("corner")
    tracker = Tracker(TrackingConfig(target="hybrid"))
    track_all(tracker, scene, path(1))
    change = se3.exp(torch.tensor([1.0, 2.0, 3.0, 0.5, 0.0, 0.1]).double())
    tracker.correct(change)
    tracker._target(scene)(
        scene.frame(path(1)[0], 1).camera,
        torch.eye(4),
    )
    assert_pose(scene.rendered[-1], change @ path(1)[0], 1e-6, 1e-4)


@pytest.mark.parametrize("target", ["model", "hybrid"])
def test_state_round_trip_goes_on_the_same(plane_scene, target):
    scene = plane_scene("corner")
    config = TrackingConfig(target=target)
    tracker = Tracker(config)
    track_all(tracker, scene, path(4))
    empty = scene.frame(path(4)[3], 4)
    empty = dataclasses.replace(empty, depth_m=torch.zeros_like(empty.depth_m))
    with pytest.raises(TrackingLostError):
        tracker.track(empty, scene)
    buffer = io.BytesIO()
    torch.save(tracker.state_dict(), buffer)
    buffer.seek(0)
    copy = Tracker.from_state_dict(config, torch.load(buffer, weights_only=True))
    assert copy.lost_in_a_row == 1
    frames = [scene.frame(T, 5 + i) for i, T in enumerate(path(2, start=5))]
    for frame in frames:
        a = tracker.track(frame, scene)
        b = copy.track(frame, scene)
        assert torch.equal(a.T_WC, b.T_WC)
    fresh = Tracker.from_state_dict(config, Tracker(config).state_dict())
    assert fresh.track(frames[0], scene).status == "first"


@pytest.mark.parametrize(("noise", "limit_m"), [("none", 0.004), ("kinect", 0.008)])
def test_the_room_is_tracked_against_its_tsdf(noise, limit_m):
    sequence = open_sequence("room", noise=noise, width=160, height=120)
    volume = TsdfVolume(TsdfConfig(voxel_size_m=0.03, truncation_voxels=4.0, near_m=0.2))
    tracker = Tracker()
    estimate = []
    truth = []
    for i in range(14):
        frame = sequence.mapping[i]
        report = tracker.track(frame, tsdf_surface(volume))
        integrate(volume, dataclasses.replace(frame, T_WC=report.T_WC))
        estimate.append(report.T_WC)
        truth.append(frame.T_WC)
    assert report.status == "ok"
    assert ate_rmse(torch.stack(estimate), torch.stack(truth), align=False) < limit_m


def test_the_clearly_better_fit_is_taken(plane_scene):
    scene = plane_scene("corner", painted=True)
    T_WC = path(1)[0]
    config = TrackingConfig()
    frame = scene.frame(T_WC)
    surface = scene(frame.camera, path(2)[1])
    sight = Sight.of(frame, config)
    right = icp(frame.depth_m, frame.camera, surface, T_WC, config)
    wrong, almost = (
        dataclasses.replace(right, T_WC=se3.exp(k * VELOCITY) @ T_WC) for k in (0.5, 0.01)
    )
    tries = {
        name: Attempt(Start(name, T_WC), surface, result)
        for name, result in (("right", right), ("wrong", wrong), ("almost", almost))
    }
    for order, best in (
        (("wrong", "right"), "right"),
        (("right", "wrong"), "right"),
        (("wrong",), "wrong"),
    ):
        assert best_of(sight, [tries[name] for name in order], config).start.name == best
    assert (
        best_of(
            sight,
            [tries["almost"], tries["right"]],
            config,
        ).start.name
        == "almost"
    )


def test_a_frozen_frame_does_not_move(plane_scene, assert_pose):
    reports = track_all(
        Tracker(),
        plane_scene("corner"),
        [*path(3), *[path(3)[2]] * 4],
    )
    for report in reports[2:]:
        assert_pose(report.T_WC, path(3)[2], 5e-4, 0.03)


def test_a_wrong_prediction_falls_back_to_the_last_pose(plane_scene, assert_pose):
    scene = plane_scene("corner")
    tracker = Tracker(TrackingConfig(max_distance_m=0.02, iterations=(3, 1, 1)))
    leap = se3.exp(torch.tensor([0.3, 0.25, 0.2, 0.1, 0.2, 0.0]).double())
    state = tracker.state_dict() | {
        "before": {"T_WC": leap, "timestamp_s": 0.0},
        "last": {"T_WC": torch.eye(4).double(), "timestamp_s": 1.0},
    }
    tracker = Tracker.from_state_dict(tracker.config, state)
    report = tracker.track(scene.frame(torch.eye(4).double(), 2), scene)
    assert (report.status, report.start) == ("recovered", "the last pose")
    assert_pose(report.T_WC, torch.eye(4), 1e-3, 0.05)


def test_a_motion_beyond_the_limit_is_refused(plane_scene):
    scene = plane_scene("corner")
    tracker = Tracker(TrackingConfig(max_step_m=0.01, max_step_deg=45.0))
    tracker.track(scene.frame(torch.eye(4).double()), scene)
    T = torch.eye(4).double()
    T[2, 3] = 0.05
    with pytest.raises(
        TrackingLostError,
        match=r"moved 0\.05 m and turned 0 degrees .* \(at most 0\.01 m and 45 deg",
    ):
        tracker.track(scene.frame(T, 1), scene)


def test_many_corrections_leave_the_path_rigid(plane_scene):
    """Each is made of the last pose, as the back end makes it; without care the rounding of the
    first would be 1 % in the twentieth."""
    tracker = Tracker()
    track_all(tracker, plane_scene("corner"), path(3))
    for k in range(25):
        last = tracker.predict(2.0)
        tracker.correct((se3.exp(0.1 * k * VELOCITY) @ se3.inverse(last)).float())
    R = tracker.predict(2.0)[:3, :3]
    assert float((R @ R.T - torch.eye(3)).abs().max()) < 1e-6


def test_a_hybrid_target_is_rendered_from_the_last_pose(plane_scene, assert_pose):
    scene = plane_scene("corner")
    tracker = Tracker(TrackingConfig(target="hybrid"))
    reports = track_all(tracker, scene, path(4))
    assert_pose(scene.rendered[-1], reports[-2].T_WC, 1e-6, 1e-3)
    assert_pose(reports[-1].T_WC, path(4)[3], 1e-3, 0.05)


def test_a_motion_found_by_somebody_else_is_carried_on_but_not_across_a_gap(
    plane_scene, assert_pose
):
    scene = plane_scene("corner")
    tracker = Tracker()
    poses = path(5)

    def is_at(T_WC):
        return lambda frame, T_predicted: T_WC

    def is_nowhere(frame, T_predicted):
        raise TrackingLostError("no pose")

    tracked = [tracker.track_by(is_at(poses[i]), scene.frame(poses[i], i)) for i in range(3)]
    assert [report.status for report in tracked] == ["first", "ok", "ok"]
    assert_pose(tracker.predict(3.0), poses[3], 1e-6, 1e-3)
    with pytest.raises(TrackingLostError, match="frame 3 cannot be tracked: no pose"):
        tracker.track_by(is_nowhere, scene.frame(poses[3], 3))
    report = tracker.track_by(is_at(poses[4]), scene.frame(poses[4], 4))
    assert report.status == "recovered"
    assert_pose(tracker.predict(5.0), poses[4], 1e-6, 1e-3)
