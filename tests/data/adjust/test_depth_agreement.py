"""Points of one depth image seen from another; finding wrong conventions from the data alone."""

import dataclasses

import pytest
import torch

from gsfusion_nb.data import SequenceError, folder
from gsfusion_nb.data.adjust.depth_agreement import (
    agreeing_share,
    depth_agreement,
    depth_consistency,
    sparse_points,
    thinned,
)
from gsfusion_nb.geometry import depth_to_points, se3
from gsfusion_nb.types import Camera


def test_agreement_of_exact_data(tmp_path, box):
    seq = folder(box.folder(tmp_path))
    agreement = depth_agreement(seq[0], seq[1], step=1)
    assert agreement.median_m < 0.01  # the lookup takes the nearest of 64x48 pixels
    assert agreement.agreeing > 0.9
    same = depth_agreement(seq[0], seq[0], step=1)
    assert same.median_m < 1e-6
    assert same.overlap == same.agreeing == 1.0
    away = dataclasses.replace(seq[1], T_WC=torch.diag(torch.tensor([-1.0, 1, -1, 1])))
    assert depth_agreement(seq[0], away).overlap == 0.0


WRONG = {
    "inverted poses": (se3.inverse, 1000.0),
    "OpenGL axes": (lambda T: T @ torch.diag(torch.tensor([1.0, -1, -1, 1], dtype=torch.float64)), 1000.0),
    "a depth scale that was 1000 instead of 5000": (lambda T: T, 200.0),
    "a depth scale that was 5000 instead of 1000": (lambda T: T, 5000.0),
}


@pytest.mark.parametrize("mistake", [None, *WRONG])
def test_mistakes_leave_less_than_a_third(tmp_path, box, mistake):
    root = box.folder(tmp_path, n=30, depth_scale=WRONG[mistake][1] if mistake else 1000.0)
    if mistake:
        lines = [" ".join(map(repr, WRONG[mistake][0](T).flatten().tolist())) for T in box.poses(30)]
        (root / "poses.txt").write_text("\n".join(lines))
    assert (agreeing_share(folder(root)) > 1 / 3) == (mistake is None)


def test_bad_frames_are_passed_over(tmp_path, box):
    root = box.folder(tmp_path, n=20)
    (root / "depth/000000.png").write_bytes(b"")
    assert agreeing_share(folder(root)) > 1 / 3
    for p in (root / "depth").iterdir():
        p.write_bytes(b"")
    with pytest.raises(SequenceError, match="has no two usable frames"):
        agreeing_share(folder(root))


@pytest.mark.parametrize("name", ["redkitchen_mini48", "livingroom1_clean211"])
def test_real_sequences_are_consistent(shared_sequence, name):
    assert agreeing_share(folder(shared_sequence(name))) > 1 / 3


CAMERA = Camera(width=8, height=6, fx=8.0, fy=8.0, cx=4.0, cy=3.0)


def test_a_wall_by_hand():
    wall = torch.full((6, 8), 2.0)
    xyz_a = sparse_points(CAMERA, wall, 1)
    assert xyz_a.shape == (48, 3)
    still, nearer, aside, behind = torch.eye(4).repeat(4, 1, 1)
    nearer[2, 3] = -0.03  # 1.5 % of 2 m: half of what counts as agreeing
    aside[0, 3] = 1.0  # a pixel is 0.25 m wide there: four of eight columns leave
    behind[2, 3] = -3.0
    found = depth_consistency(xyz_a, wall, CAMERA, torch.stack([still, nearer, aside, behind]))
    assert found.agreeing.tolist() == [1.0, 1.0, 0.5, 0.0]
    assert found.overlap.tolist() == [1.0, 1.0, 0.5, 0.0]
    assert found.score.tolist() == pytest.approx([1.0, 0.5, 0.5, 0.0], abs=1e-5)
    assert found.median_m[:3].tolist() == pytest.approx([0.0, 0.03, 0.0], abs=1e-6)
    assert found.median_m[3].isnan()


def test_missing_depth_is_no_point():
    depth_m = torch.zeros(6, 8)
    found = depth_consistency(sparse_points(CAMERA, depth_m, 1), depth_m, CAMERA, torch.eye(4)[None])
    assert found.agreeing.tolist() == found.score.tolist() == [0.0]
    assert found.median_m.isnan().all()


@pytest.mark.parametrize("step", [1, 2, 3, 4])
def test_thinned_depth_keeps_its_rays(generator, step):
    depth_m = torch.rand(6, 8, generator=generator) + 1
    camera, small = thinned(CAMERA, depth_m, step)
    first = (step - 1) // 2
    assert (camera.height, camera.width) == tuple(small.shape)
    expected = depth_to_points(CAMERA, depth_m)[first::step, first::step]
    assert torch.allclose(depth_to_points(camera, small), expected, atol=1e-6)
