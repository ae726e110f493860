"""The mistakes of a hand-held recording that the room can be given, with the truth known."""

from typing import Any

import pytest
import torch

from gsfusion_nb.data.room import room
from gsfusion_nb.data.room.trajectory import walk
from gsfusion_nb.geometry import backproject, pixel_grid, se3

SMALL: dict[str, Any] = {"n_frames": 200, "width": 80, "height": 60}


def twists(sequence):
    """log(true^-1 given) of every frame, metres and radians. [n, 6]"""
    pairs = [(sequence.true_pose(i).double(), sequence.pose(i).double()) for i in range(len(sequence))]
    return torch.stack([se3.log(se3.inverse(true) @ given) for true, given in pairs])


def test_poses_wander_about_the_truth_by_the_given_deviation():
    clean = room(**SMALL)
    off = room(**SMALL, pose_error_m=0.01, pose_error_deg=0.5)
    assert torch.equal(off.true_pose(7), clean.pose(7))
    assert torch.equal(off[7].T_WC, off.pose(7))
    pictures = [sequence._render(7)["rgb"] for sequence in (off, clean)]  # what the cache would store
    assert (pictures[0] == pictures[1]).all()
    xi = twists(off)
    assert xi[:, :3].std().item() == pytest.approx(0.01, rel=0.2)
    assert xi[:, 3:].std().rad2deg().item() == pytest.approx(0.5, rel=0.2)
    assert (xi[1:] - xi[:-1]).norm(dim=1).median() < xi.norm(dim=1).median()  # white noise: 1.4 times


def test_a_delay_gives_each_image_a_later_pose():
    later = room(**SMALL, pose_delay_s=0.5)
    times = later.times_s
    step_s = float(times[1] - times[0])
    fine = room(n_frames=1 + round(199 * step_s / 0.05), width=80, height=60)  # a frame about every 0.05 s
    i = 40
    expected = walk("mapping", 200, 0, delay_s=0.5)[0][i]
    torch.testing.assert_close(later.pose(i).double(), torch.from_numpy(expected), atol=1e-6, rtol=0)
    nearest = fine.pose(round((float(times[i]) + 0.5) / float(fine.times_s[1])))
    assert (later.pose(i)[:3, 3] - nearest[:3, 3]).norm() < 0.03
    assert later.times_s[i] == times[i]


def test_exposure_multiplies_the_colours_and_is_one_on_average():
    clean, wandering = room(**SMALL), room(**SMALL, exposure_stops=0.4)
    ratios = []
    for i in range(0, 200, 20):
        a, b = clean[i].rgb, wandering[i].rgb
        used = (a > 0.2) & (b < 0.98)
        gain = torch.stack([(b[..., c][used[..., c]] / a[..., c][used[..., c]]).median() for c in range(3)])
        assert ((a * gain).clamp(max=1) - b).abs().max() < 0.03
        ratios.append(gain.log2() * 2.2)
    assert torch.stack(ratios).mean(1).std().item() == pytest.approx(0.4, rel=0.5)


def test_holes_belong_to_surfaces_and_not_to_views():
    clean, holed = room(**SMALL), room(**SMALL, holes=0.3)
    a, b = clean[50].depth_m, holed[50].depth_m
    assert torch.equal(b[b > 0], a[b > 0])
    assert 0.15 < float((b == 0).float().mean()) < 0.5
    # a point without depth has none in the next view, either
    camera, T = clean.camera, clean.pose(50)
    lost = se3.apply(T, backproject(camera, pixel_grid(camera), a))[(b == 0)]
    x = se3.apply(se3.inverse(clean.pose(51)), lost)
    u = camera.fx * x[:, 0] / x[:, 2] + camera.cx
    v = camera.fy * x[:, 1] / x[:, 2] + camera.cy
    inside = (u >= 0) & (u < 80) & (v >= 0) & (v < 60)
    i, j = u[inside].long(), v[inside].long()
    visible = (clean[51].depth_m[j, i] - x[inside, 2]).abs() < 0.02
    assert (holed[51].depth_m[j, i][visible] == 0).float().mean() > 0.7


def test_wrong_amounts_are_named():
    with pytest.raises(ValueError, match="room: holes must be between 0 and 1, got 2"):
        room(holes=2.0)
