"""The back end on simulated walks with injected drift: loops close, false ones do not, odd input is survived."""

import dataclasses
import math

import pytest
import torch

from gsfusion_nb.config import BackEndConfig
from gsfusion_nb.data.room import render_room, room
from gsfusion_nb.data.room.camera import look_at
from gsfusion_nb.evaluation import ate_rmse
from gsfusion_nb.export import CheckpointStore
from gsfusion_nb.geometry import se3
from gsfusion_nb.tracking.back_end import BackEnd, Correction
from gsfusion_nb.types import Camera, Frame

pytest.importorskip("gtsam", reason="the extra 'slam' is not installed")

CAMERA = Camera(width=320, height=240, fx=208.0, fy=208.0, cx=160.0, cy=120.0)


def on_the_circle(angle_deg):
    """Outwards from a circle of 0.9 m in the middle of the room."""
    angle = math.radians(angle_deg)
    eye = torch.tensor([0.9 * math.cos(angle), 0.7 * math.sin(angle), 1.5], dtype=torch.float64).numpy()
    target = eye + torch.tensor([2 * math.cos(angle), 2 * math.sin(angle), -0.5], dtype=torch.float64).numpy()
    return torch.from_numpy(look_at(eye, target)).float()


@pytest.fixture(scope="module")
def circle():
    """Once around and 60 degrees further, a keyframe every 12 degrees."""
    frames = []
    for i in range(36):
        T_WC = on_the_circle(12.0 * i)
        rgb, depth_m = render_room(CAMERA, T_WC)
        frames.append(Frame(index=3 * i, timestamp_s=float(i), rgb=rgb, depth_m=depth_m, camera=CAMERA, T_WC=T_WC))
    return frames


def odometry(true, generator, *, share=0.005, degrees=0.2, bias_deg=0.0):
    """Steps of the true path, each with an error: a share of its length, and a rotation."""
    true = true.double()
    steps = se3.inverse(true[:-1]) @ true[1:]
    error = torch.randn(len(steps), 6, generator=generator, dtype=torch.float64)
    error[:, :3] *= share * steps[:, :3, 3].norm(dim=1, keepdim=True)
    error[:, 3:] *= math.radians(degrees)
    error[:, 4] += math.radians(bias_deg)
    return steps @ se3.exp(error)


def drive(back_end, frames, steps, start):
    """The front end's part, each frame a keyframe: poses as tracked, as they drift alone, and the corrections."""
    back_end.add(frames[0], start.double())
    return drive_on(back_end, frames[1:], steps, (start.double()[None], start.double()[None], []))


def drive_on(back_end, frames, steps, before):
    """``drive`` with more frames, after what it gave ``before``."""
    tracked, drifted, corrections = list(before[0]), list(before[1]), list(before[2])
    for frame, step in zip(frames, steps, strict=True):
        T_WC = tracked[-1] @ step
        drifted.append(drifted[-1] @ step)
        correction = back_end.add(frame, T_WC)
        if correction is not None:
            corrections.append(correction)
            T_WC = correction.T_WC_new[-1]
        tracked.append(T_WC)
    return torch.stack(tracked), torch.stack(drifted), corrections


@pytest.fixture(scope="module")
def walked(circle, tmp_path_factory):
    """A drifting walk along all of the circle, with what ``drive`` gave, and a store of the back end's state before
    the last four keyframes; not to be changed."""
    true = torch.stack([f.T_WC for f in circle])
    back_end, store = BackEnd(BackEndConfig(), CAMERA), CheckpointStore(tmp_path_factory.mktemp("walked"))
    steps = odometry(true, torch.Generator().manual_seed(0), bias_deg=0.2)
    before = drive(back_end, circle[:32], steps[:31], true[0])
    store.save(back_end.state_dict())
    after = drive_on(back_end, circle[32:], steps[31:], before)
    return back_end, store, steps, after, back_end.finish()


def test_a_drifting_walk_around_the_room_closes(circle, walked):
    true = torch.stack([f.T_WC for f in circle])
    back_end, _, _, (tracked, drifted, corrections), last = walked
    index = torch.tensor([f.index for f in circle])
    assert last is not None
    assert last.error_after <= last.error_before
    final = back_end.correct_trajectory(index, tracked)
    before, after = ate_rmse(drifted, true.double()), ate_rmse(final, true.double())
    assert before > 0.02
    assert after < before / 5
    assert corrections
    assert all(n >= 30 and a > b for c in corrections for a, b, n in c.loops)
    torch.testing.assert_close(back_end.T_WC, final, atol=1e-5, rtol=0)


def test_evo_agrees(circle, generator):
    """The same numbers from another program."""
    metrics = pytest.importorskip("evo.core.metrics")
    trajectory = pytest.importorskip("evo.core.trajectory")
    true = torch.stack([f.T_WC for f in circle]).double()
    estimate = true @ se3.exp(0.02 * torch.randn(len(true), 6, generator=generator, dtype=torch.float64))
    paths = [trajectory.PosePath3D(poses_se3=list(p.numpy())) for p in (true, estimate)]
    paths[1].align(paths[0])
    ape = metrics.APE(metrics.PoseRelation.translation_part)
    ape.process_data(tuple(paths))
    assert ate_rmse(estimate, true) == pytest.approx(ape.get_statistic(metrics.StatisticsType.rmse), rel=1e-6)


def test_a_slip_of_the_front_end_is_mended(circle, generator):
    """Landmarks are found again although the front end's pose is 25 cm off, and outweigh it, however precise its other
    steps are."""
    true = torch.stack([f.T_WC for f in circle[:16]])
    steps = odometry(true, generator, share=0.001, degrees=0.02)
    steps[8] = steps[8] @ se3.exp(torch.tensor([0.25, 0, 0, 0, 0, 0], dtype=torch.float64))
    back_end = BackEnd(BackEndConfig(), CAMERA)
    _, slipped, _ = drive(back_end, circle[:16], steps, true[0])
    back_end.finish()
    assert ate_rmse(slipped, true.double()) > 0.1
    assert ate_rmse(back_end.T_WC, true.double()) < 0.01


@pytest.mark.ci
def test_exact_poses_stay_exact(circle):
    """The landmarks' errors must not spoil a front end that makes none."""
    true = torch.stack([f.T_WC for f in circle]).double()
    back_end = BackEnd(BackEndConfig(), CAMERA)
    tracked, _, _ = drive(back_end, circle, se3.inverse(true[:-1]) @ true[1:], true[0])
    back_end.finish()
    final = back_end.correct_trajectory(torch.tensor([f.index for f in circle]), tracked)
    assert ate_rmse(final, true) < 0.004


def test_where_nothing_changed_the_trajectory_passes_through(circle, generator):
    back_end = BackEnd(BackEndConfig(), CAMERA)
    for frame in circle[:6]:
        assert back_end.add(frame, frame.T_WC) is None
    index = torch.arange(0, 30)
    poses = se3.exp(torch.randn(30, 6, generator=generator))
    assert torch.equal(back_end.correct_trajectory(index, poses), poses)


def test_frames_between_keyframes_move_with_them(circle, generator):
    """Keyframes at 0, 3, 6, ... of which every second one is left out, but tracked by the same odometry."""
    true = torch.stack([f.T_WC for f in circle]).double()
    steps = odometry(true, generator, bias_deg=0.2)
    back_end = BackEnd(BackEndConfig(loop_min_gap=4), CAMERA)
    T_WC, tracked = true[0], []
    for i, frame in enumerate(circle):
        T_WC = T_WC @ steps[i - 1] if i else T_WC
        if i % 2 == 0 and (correction := back_end.add(frame, T_WC)) is not None:
            T_WC = correction.T_WC_new[-1]
        tracked.append(T_WC)
    back_end.finish()
    final = back_end.correct_trajectory(torch.tensor([f.index for f in circle]), torch.stack(tracked))
    assert ate_rmse(final[1::2], true[1::2]) < 1.5 * ate_rmse(final[::2], true[::2]) + 0.002


def test_state_goes_on_where_it_was(circle, walked):
    one, store, steps, (tracked, drifted, corrections), _ = walked
    two = BackEnd.from_state_dict(BackEndConfig(), CAMERA, store.load().state)
    again, _, _ = drive_on(two, circle[32:], steps[31:], (tracked[:32], drifted[:32], corrections))
    two.finish()
    torch.testing.assert_close(again, tracked, atol=1e-9, rtol=0)
    torch.testing.assert_close(one.T_WC, two.T_WC, atol=1e-9, rtol=0)
    index = torch.tensor([f.index for f in circle])
    torch.testing.assert_close(
        one.correct_trajectory(index, tracked), two.correct_trajectory(index, tracked), atol=1e-9, rtol=0
    )


def test_wants_a_keyframe_after_enough_motion(circle):
    back_end = BackEnd(BackEndConfig(keyframe_rotation_deg=15.0, keyframe_translation_m=0.15), CAMERA)
    T_WC = circle[0].T_WC.double()
    assert back_end.wants(T_WC)
    back_end.add(circle[0], T_WC)
    for twist, wanted in (
        ([0, 0, 0.14, 0, 0, 0], False),
        ([0, 0, 0.16, 0, 0, 0], True),
        ([0, 0, 0, 0, 0.25, 0], False),
    ):
        assert back_end.wants(T_WC @ se3.exp(torch.tensor(twist, dtype=torch.float64))) == wanted
    assert back_end.wants((T_WC @ se3.exp(torch.tensor([0, 0, 0, 0, 0.27, 0.0], dtype=torch.float64))).float())


def test_wallpaper_closes_no_loop():
    """A periodic wall, walked along: views one period apart are the same picture."""
    back_end = BackEnd(BackEndConfig(loop_min_gap=2), CAMERA)
    generator = torch.Generator().manual_seed(5)
    tile = torch.rand(24, 32, 3, generator=generator)
    tile = torch.nn.functional.interpolate(tile.permute(2, 0, 1)[None], scale_factor=2)[0].permute(1, 2, 0)
    wall = tile.repeat(5, 12, 1).contiguous()  # one period is 64 pixels: 0.615 m at 2 m
    for i in range(12):
        rgb = wall[:, 22 * i : 22 * i + 320].contiguous()
        T_WC = torch.eye(4)
        T_WC[0, 3] = 22 * i * 2.0 / 208.0
        back_end.add(_frame(3 * i, rgb, torch.full((240, 320), 2.0), T_WC), T_WC)
    assert back_end.loops == []
    drift = back_end.T_WC[:, 0, 3] - torch.arange(12, dtype=torch.float64) * 22 * 2.0 / 208.0
    assert float(drift.abs().max()) < 1e-6


def test_two_rooms_that_look_the_same_are_two_rooms(circle):
    """After a corridor without features, 12 m further, the same room again: nothing but the path tells them apart."""
    back_end = BackEnd(BackEndConfig(loop_min_gap=3), CAMERA)
    for frame in circle[:4]:
        back_end.add(frame, frame.T_WC)
    shift = torch.eye(4)
    for i in range(4):
        shift = torch.eye(4)
        shift[0, 3] = 3.0 * (i + 1)
        grey = _frame(20 + i, torch.full((240, 320, 3), 0.5), torch.full((240, 320), 2.0), circle[3].T_WC)
        back_end.add(grey, shift @ circle[3].T_WC)
    for frame in circle[3::-1]:
        same = dataclasses.replace(frame, index=100 - frame.index)
        assert back_end.add(same, shift @ frame.T_WC) is None
    assert back_end.loops == []


def test_identical_frames_agree(circle):
    back_end = BackEnd(BackEndConfig(loop_min_gap=2), CAMERA)
    for i in range(5):
        assert back_end.add(dataclasses.replace(circle[0], index=i), circle[0].T_WC) is None
    back_end.finish()
    torch.testing.assert_close(back_end.T_WC, circle[0].T_WC.double().expand(5, 4, 4), atol=1e-5, rtol=0)


@pytest.mark.parametrize("kind", ["black", "no depth", "no depth, black"])
def test_bad_keyframes_are_survived(circle, kind):
    back_end = BackEnd(BackEndConfig(loop_min_gap=3), CAMERA)
    poses = []
    for i, frame in enumerate(circle[:9]):
        if 3 <= i < 6:
            black = torch.zeros_like(frame.rgb) if "black" in kind else frame.rgb
            depth_m = torch.zeros_like(frame.depth_m) if "no depth" in kind else frame.depth_m
            frame = dataclasses.replace(frame, rgb=black, depth_m=depth_m)
        back_end.add(frame, frame.T_WC)
        poses.append(frame.T_WC)
    correction = back_end.finish()
    assert correction is not None
    assert torch.isfinite(correction.T_WC_new).all()
    assert ate_rmse(correction.T_WC_new, torch.stack(poses).double()) < 0.02


def test_none_and_one_keyframe(circle):
    back_end = BackEnd(BackEndConfig(), CAMERA)
    poses = torch.eye(4).expand(3, 4, 4)
    assert back_end.finish() is None
    assert torch.equal(back_end.correct_trajectory(torch.arange(3), poses), poses)
    back_end.add(circle[0], circle[0].T_WC)
    assert back_end.finish() is None
    assert torch.equal(back_end.correct_trajectory(torch.arange(3), poses), poses)
    state = BackEnd.from_state_dict(BackEndConfig(), CAMERA, back_end.state_dict())
    assert torch.equal(state.T_WC, back_end.T_WC)


def test_wrong_input_is_refused(circle):
    back_end = BackEnd(BackEndConfig(), CAMERA)
    back_end.add(circle[1], circle[1].T_WC)
    with pytest.raises(ValueError, match="order of their frames, got 0 after 3"):
        back_end.add(circle[0], circle[0].T_WC)
    with pytest.raises(ValueError, match="T_WC must be rigid"):
        back_end.add(circle[2], 2 * circle[2].T_WC)
    small = room(n_frames=2, width=160, height=120)[1]
    with pytest.raises(ValueError, match="must come from the back end's camera"):
        back_end.add(dataclasses.replace(small, index=9), small.T_WC)
    assert len(back_end) == 1


@pytest.mark.slow
def test_the_long_walk_through_the_room(generator):
    """Random walk of 0.5 % and 0.2 degrees per keyframe over the whole built-in walk."""
    sequence = room(n_frames=400, width=320, height=240)
    back_end = BackEnd(BackEndConfig(), sequence.camera)
    chosen = [0]
    for i in range(1, 400):
        step = se3.inverse(sequence.pose(chosen[-1])) @ sequence.pose(i)
        if step[:3, 3].norm() > 0.15 or se3.rotation_angle(step[:3, :3]) > math.radians(15):
            chosen.append(i)
    true = torch.stack([sequence.pose(i) for i in chosen])
    frames = [sequence[i] for i in chosen]
    tracked, drifted, _ = drive(back_end, frames, odometry(true, generator), true[0])
    back_end.finish()
    final = back_end.correct_trajectory(torch.tensor(chosen), tracked)
    assert ate_rmse(final, true.double()) < ate_rmse(drifted, true.double()) / 5


def _frame(index, rgb, depth_m, T_WC):
    return Frame(index=index, timestamp_s=float(index), rgb=rgb, depth_m=depth_m, camera=CAMERA, T_WC=T_WC)


def poses(*twists):
    return se3.exp(torch.tensor(twists, dtype=torch.float64))


def correction(old, new, index=(10, 20, 40)):
    return Correction(
        frame_index=torch.tensor(index[: len(old)], dtype=torch.int64),
        T_WC_old=old,
        T_WC_new=new,
        loops=[],
        error_before=1.0,
        error_after=0.5,
    )


OLD = [(0.0, 0, 0, 0, 0, 0), (1.0, 0, 0, 0, 0.1, 0), (2.0, 0, 0, 0, 0.2, 0)]
NEW = [(0.0, 0, 0, 0, 0, 0), (1.0, 0.1, 0, 0, 0.15, 0), (2.0, 0.3, 0, 0, 0.3, 0.1)]


def test_at_keyframes_it_is_new_times_old_inverse():
    old, new = poses(*OLD), poses(*NEW)
    D = correction(old, new).transform_of(torch.tensor([40, 10, 20]))
    torch.testing.assert_close(D @ old[[2, 0, 1]], new[[2, 0, 1]], atol=1e-9, rtol=0)


def test_before_the_first_and_after_the_last_it_is_theirs():
    old, new = poses(*OLD), poses(*NEW)
    c = correction(old, new[[1, 0, 2]])
    torch.testing.assert_close(c.transform_of(torch.tensor([0, 99])), c.transform_of(torch.tensor([10, 40])))


def test_between_two_shifts_it_is_their_mean():
    old = poses(*OLD[:2])
    shift = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)
    shift[0, 0, 3], shift[1, 0, 3] = 0.1, 0.3
    D = correction(old, shift @ old).transform_of(torch.tensor([15, 12]))
    torch.testing.assert_close(D[:, 0, 3], torch.tensor([0.2, 0.14], dtype=torch.float64), atol=1e-9, rtol=0)


def test_between_two_turns_it_turns_half_about_the_camera():
    """Both keyframes stand at the same place far from the origin; only the later one turns, about itself."""
    old = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)
    old[:, :3, 3] = torch.tensor([100.0, 0, 0])
    new = old.clone()
    new[1] = old[1] @ poses((0, 0, 0, 0, 0, 0.2))[0]
    D = correction(old, new).transform_of(torch.tensor([15]))[0]
    torch.testing.assert_close(D @ old[0], old[0] @ poses((0, 0, 0, 0, 0, 0.1))[0], atol=1e-9, rtol=0)


def test_exactly_the_identity_where_nothing_moved():
    old = poses(*OLD)
    new = old.clone()
    new[2] = poses(NEW[2])[0]
    D = correction(old, new).transform_of(torch.arange(0, 21))
    assert torch.equal(D, torch.eye(4, dtype=torch.float64).expand(21, 4, 4))


def test_result_is_rigid():
    D = correction(poses(*OLD), poses(*NEW)).transform_of(torch.arange(50))
    R = D[:, :3, :3]
    torch.testing.assert_close(R @ R.mT, torch.eye(3, dtype=torch.float64).expand_as(R), atol=1e-12, rtol=0)


@pytest.mark.parametrize("keyframes", [0, 1])
def test_none_and_one_keyframe_correction(keyframes):
    old = poses(*OLD)[:keyframes]
    D = correction(old, poses(NEW[2]).expand(keyframes, 4, 4)).transform_of(torch.tensor([3, 10, 50]))
    assert D.shape == (3, 4, 4)
    torch.testing.assert_close(D[0], D[2])
