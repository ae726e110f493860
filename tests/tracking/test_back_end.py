"""The back end on simulated walks with injected drift: loops close, false ones do not, odd input is
survived."""

import dataclasses
import math

import pytest
import torch

from gsfusion_nb.data.room import render_room
from gsfusion_nb.data.room.camera import look_at
from gsfusion_nb.evaluation import ate_rmse
from gsfusion_nb.export import CheckpointStore
from gsfusion_nb.geometry import se3
from gsfusion_nb.tracking import loop_finder
from gsfusion_nb.tracking.back_end import BackEnd
from gsfusion_nb.tracking.correction import Correction
from gsfusion_nb.types import Camera, Frame

CAMERA = Camera(
    width=320,
    height=240,
    fx=208.0,
    fy=208.0,
    cx=160.0,
    cy=120.0,
)


def on_the_circle(angle_deg):
    """Outwards from a circle of 0.9 m in the middle of the room."""
    angle = math.radians(angle_deg)
    eye = torch.tensor(
        [0.9 * math.cos(angle), 0.7 * math.sin(angle), 1.5],
        dtype=torch.float64,
    ).numpy()
    target = (
        eye
        + torch.tensor(
            [2 * math.cos(angle), 2 * math.sin(angle), -0.5],
            dtype=torch.float64,
        ).numpy()
    )
    return torch.from_numpy(look_at(eye, target)).float()


@pytest.fixture(scope="module")
def circle():
    """Once around and 60 degrees further, a keyframe every 12 degrees."""
    frames = []
    for i in range(36):
        T_WC = on_the_circle(12.0 * i)
        rgb, depth_m = render_room(CAMERA, T_WC)
        frames.append(
            Frame(
                index=3 * i,
                timestamp_s=float(i),
                rgb=rgb,
                depth_m=depth_m,
                camera=CAMERA,
                T_WC=T_WC,
            )
        )
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
    """The front end's part, each frame a keyframe: poses as tracked, as they drift alone, and the
    corrections."""
    back_end.add(frames[0], start.double())
    return drive_on(
        back_end,
        frames[1:],
        steps,
        (start.double()[None], start.double()[None], []),
    )


def drive_on(back_end, frames, steps, before):
    """``drive`` with more frames, after what it gave ``before``."""
    tracked = list(before[0])
    drifted = list(before[1])
    corrections = list(before[2])
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
    """A drifting walk along all of the circle, with what ``drive`` gave, and a store of the back
    end's state before the last four keyframes; not to be changed."""
    true = torch.stack([f.T_WC for f in circle])
    back_end = BackEnd(CAMERA)
    store = CheckpointStore(tmp_path_factory.mktemp("walked"))
    steps = odometry(true, torch.Generator().manual_seed(0), bias_deg=0.2)
    before = drive(back_end, circle[:32], steps[:31], true[0])
    store.save(back_end.state_dict())
    after = drive_on(back_end, circle[32:], steps[31:], before)
    return back_end, store, steps, after, back_end.finish()


def test_a_drifting_walk_around_the_room_closes(circle, walked):
    true = torch.stack([f.T_WC for f in circle])
    back_end, _, _, (_, drifted, corrections), last = walked
    assert last is not None
    before = ate_rmse(drifted, true.double())
    after = ate_rmse(back_end.T_WC, true.double())
    assert before > 0.02
    assert after < before / 5
    assert corrections
    assert all(n >= 30 and a > b for c in corrections for a, b, n in c.loops)


def test_a_slip_of_the_front_end_is_mended(circle, generator):
    """Landmarks are found again although the front end's pose is 25 cm off, and outweigh it,
    however precise its other steps are."""
    true = torch.stack([f.T_WC for f in circle[:16]])
    steps = odometry(true, generator, share=0.001, degrees=0.02)
    steps[8] = steps[8] @ se3.exp(torch.tensor([0.25, 0, 0, 0, 0, 0], dtype=torch.float64))
    back_end = BackEnd(CAMERA)
    _, slipped, _ = drive(back_end, circle[:16], steps, true[0])
    back_end.finish()
    assert ate_rmse(slipped, true.double()) > 0.1
    assert ate_rmse(back_end.T_WC, true.double()) < 0.01


def test_state_goes_on_where_it_was(circle, walked):
    one, store, steps, (tracked, drifted, corrections), _ = walked
    two = BackEnd.from_state_dict(CAMERA, store.load().state)
    again, _, _ = drive_on(
        two,
        circle[32:],
        steps[31:],
        (tracked[:32], drifted[:32], corrections),
    )
    two.finish()
    torch.testing.assert_close(again, tracked, atol=1e-9, rtol=0)
    torch.testing.assert_close(one.T_WC, two.T_WC, atol=1e-9, rtol=0)


def test_wants_a_keyframe_after_enough_motion(circle):
    back_end = BackEnd(CAMERA)
    T_WC = circle[0].T_WC.double()
    assert back_end.wants(T_WC)
    back_end.add(circle[0], T_WC)
    for twist, wanted in (
        ([0, 0, 0.14, 0, 0, 0], False),
        ([0, 0, 0.16, 0, 0, 0], True),
        ([0, 0, 0, 0, 0.25, 0], False),
    ):
        assert back_end.wants(T_WC @ se3.exp(torch.tensor(twist, dtype=torch.float64))) == wanted
    assert back_end.wants(
        (T_WC @ se3.exp(torch.tensor([0, 0, 0, 0, 0.27, 0.0], dtype=torch.float64))).float()
    )


def test_wallpaper_closes_no_loop(monkeypatch):
    """A periodic wall, walked along: views one period apart are the same picture."""
    monkeypatch.setattr(loop_finder, "MIN_GAP", 2)
    back_end = BackEnd(CAMERA)
    generator = torch.Generator().manual_seed(5)
    tile = torch.rand(24, 32, 3, generator=generator)
    tile = torch.nn.functional.interpolate(tile.permute(2, 0, 1)[None], scale_factor=2)[0].permute(
        1, 2, 0
    )
    wall = tile.repeat(5, 12, 1).contiguous()  # one period is 64 pixels: 0.615 m at 2 m
    for i in range(12):
        rgb = wall[:, 22 * i : 22 * i + 320].contiguous()
        T_WC = torch.eye(4)
        T_WC[0, 3] = 22 * i * 2.0 / 208.0
        back_end.add(
            _frame(3 * i, rgb, torch.full((240, 320), 2.0), T_WC),
            T_WC,
        )
    assert back_end.loops == []
    drift = back_end.T_WC[:, 0, 3] - torch.arange(12, dtype=torch.float64) * 22 * 2.0 / 208.0
    assert float(drift.abs().max()) < 1e-6


def test_two_rooms_that_look_the_same_are_two_rooms(circle, monkeypatch):
    """After a corridor without features, 12 m further, the same room again: nothing but the path
    tells them apart."""
    monkeypatch.setattr(loop_finder, "MIN_GAP", 3)
    back_end = BackEnd(CAMERA)
    for frame in circle[:4]:
        back_end.add(frame, frame.T_WC)
    shift = torch.eye(4)
    for i in range(4):
        shift = torch.eye(4)
        shift[0, 3] = 3.0 * (i + 1)
        grey = _frame(
            20 + i,
            torch.full((240, 320, 3), 0.5),
            torch.full((240, 320), 2.0),
            circle[3].T_WC,
        )
        back_end.add(grey, shift @ circle[3].T_WC)
    for frame in circle[3::-1]:
        same = dataclasses.replace(frame, index=100 - frame.index)
        assert back_end.add(same, shift @ frame.T_WC) is None
    assert back_end.loops == []


@pytest.mark.parametrize("kind", ["black", "no depth", "no depth, black"])
def test_bad_keyframes_are_survived(circle, kind, monkeypatch):
    monkeypatch.setattr(loop_finder, "MIN_GAP", 3)
    back_end = BackEnd(CAMERA)
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


def _frame(index, rgb, depth_m, T_WC):
    return Frame(
        index=index,
        timestamp_s=float(index),
        rgb=rgb,
        depth_m=depth_m,
        camera=CAMERA,
        T_WC=T_WC,
    )


def poses(*twists):
    return se3.exp(torch.tensor(twists, dtype=torch.float64))


def correction(old, new, index=(10, 20, 40)):
    return Correction(
        frame_index=torch.tensor(index[: len(old)], dtype=torch.int64),
        T_WC_old=old,
        T_WC_new=new,
        loops=[],
    )


OLD = [(0.0, 0, 0, 0, 0, 0), (1.0, 0, 0, 0, 0.1, 0), (2.0, 0, 0, 0, 0.2, 0)]
NEW = [(0.0, 0, 0, 0, 0, 0), (1.0, 0.1, 0, 0, 0.15, 0), (2.0, 0.3, 0, 0, 0.3, 0.1)]


def test_at_keyframes_it_is_new_times_old_inverse():
    old = poses(*OLD)
    new = poses(*NEW)
    D = correction(old, new).transform_of(torch.tensor([40, 10, 20]))
    torch.testing.assert_close(
        D @ old[[2, 0, 1]],
        new[[2, 0, 1]],
        atol=1e-9,
        rtol=0,
    )


def test_between_two_turns_it_turns_half_about_the_camera():
    """Both keyframes stand at the same place far from the origin; only the later one turns, about
    itself."""
    old = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)
    old[:, :3, 3] = torch.tensor([100.0, 0, 0])
    new = old.clone()
    new[1] = old[1] @ poses((0, 0, 0, 0, 0, 0.2))[0]
    D = correction(old, new).transform_of(torch.tensor([15]))[0]
    torch.testing.assert_close(
        D @ old[0],
        old[0] @ poses((0, 0, 0, 0, 0, 0.1))[0],
        atol=1e-9,
        rtol=0,
    )


def test_exactly_the_identity_where_nothing_moved():
    old = poses(*OLD)
    new = old.clone()
    new[2] = poses(NEW[2])[0]
    D = correction(old, new).transform_of(torch.arange(0, 21))
    assert torch.equal(
        D,
        torch.eye(4, dtype=torch.float64).expand(21, 4, 4),
    )
