"""Corrections of a recording while it is read: each undoes its mistake, and DataConfig carries
them."""

import dataclasses

import cv2
import numpy as np
import pytest
import torch

from gsfusion_nb.config import DataConfig, RepairConfig, from_dict, to_dict
from gsfusion_nb.config.repair import AXES, NAMED_AXES
from gsfusion_nb.data import BadFrameError, SequenceError, folder, open_sequence, repaired
from gsfusion_nb.data.adjust.poses import reread_poses
from gsfusion_nb.data.adjust.repair import shifted_colour
from gsfusion_nb.geometry import quaternion, se3
from gsfusion_nb.geometry.pose_path import pose_between


@pytest.fixture
def poses(generator):
    """Twenty rigid transforms."""
    return se3.exp(torch.randn(20, 6, generator=generator, dtype=torch.float64))


def write_poses(root, poses):
    (root / "poses.txt").write_text(
        "\n".join(" ".join(map(repr, T.flatten().tolist())) for T in poses)
    )


def test_nothing_changes_nothing(tmp_path, box):
    sequence = folder(box.folder(tmp_path))
    assert repaired(sequence, RepairConfig()) is sequence
    assert RepairConfig().flags == ""
    assert RepairConfig().changes == {}
    assert open_sequence(tmp_path).source.pose(1).equal(sequence.pose(1))


def test_axes_by_hand(poses):
    gl = reread_poses(poses, RepairConfig(axes="opengl"))
    assert torch.allclose(
        gl,
        poses @ torch.diag(torch.tensor([1.0, -1, -1, 1], dtype=torch.float64)),
    )
    ros = reread_poses(
        torch.eye(4, dtype=torch.float64)[None],
        RepairConfig(axes="ros"),
    )[0]
    # a body at the origin, x forward and z up: the camera looks along the world's x, its y down is
    # the world's -z
    assert ros[:3, 2].tolist() == [1, 0, 0]
    assert ros[:3, 1].tolist() == [0, 0, -1]
    assert len(set(AXES)) == 48
    assert set(NAMED_AXES.values()) <= set(AXES)


@pytest.mark.parametrize("axes", AXES)
def test_all_axes_give_rigid_poses(poses, axes):
    T = reread_poses(poses, RepairConfig(axes=axes))
    eye = torch.eye(3, dtype=torch.float64)
    assert torch.allclose(
        T[:, :3, :3] @ T[:, :3, :3].transpose(1, 2),
        eye.expand(20, 3, 3),
        atol=1e-12,
    )
    assert (torch.linalg.det(T[:, :3, :3]) > 0.999).all()


def test_each_mistake_is_undone(poses):
    def with_rotation(R):
        T = poses.clone()
        T[:, :3, :3] = R
        return T

    quat = quaternion.from_matrix(poses[:, :3, :3])
    scaled = poses.clone()
    scaled[:, :3, :3] *= 1.7
    millimetres = poses.clone()
    millimetres[:, :3, 3] *= 1000
    mistakes = [
        (se3.inverse(poses), RepairConfig(poses="world_to_camera")),
        (with_rotation(poses[:, :3, :3].transpose(1, 2)), RepairConfig(poses="rotation_inverted")),
        (
            with_rotation(quaternion.to_matrix(quat[:, [3, 0, 1, 2]])),
            RepairConfig(quaternions="wxyz"),
        ),
        (
            with_rotation(quaternion.to_matrix(quat[:, [1, 2, 3, 0]])),
            RepairConfig(quaternions="xyzw"),
        ),
        (poses.transpose(1, 2), RepairConfig(matrices="column_major")),
        (scaled, RepairConfig(nearest_rotation=True)),
        (millimetres, RepairConfig(translation_factor=0.001)),
    ]
    for stored, repair in mistakes:
        assert torch.allclose(reread_poses(stored, repair), poses, atol=1e-9), repair
        assert not torch.allclose(stored, poses, atol=1e-3)


def test_depth_poses_and_intrinsics_of_a_recording(tmp_path, box):
    root = box.folder(tmp_path, n=6, depth_scale=200.0)
    write_poses(
        root,
        torch.stack([torch.linalg.inv(T) for T in box.poses(6)]),
    )
    config = DataConfig(
        repair=RepairConfig(depth_factor=0.2, poses="world_to_camera"), hold_out_every=0
    )
    for frame in open_sequence(root, data=config):
        assert box.off_wall_m(frame) < 0.002
    pixels = RepairConfig(depth_factor=0.2, fx=30.0, cx=10.0, pixel_shift=0.5)
    camera = open_sequence(root, data=DataConfig(repair=pixels)).camera
    assert (camera.fx, camera.fy, camera.cx) == (30.0, box.camera.fy, 10.5)
    assert camera.cy == pytest.approx(box.camera.cy + 0.5)


def test_depth_along_the_ray(tmp_path, box):
    sequence = folder(box.folder(tmp_path, n=1))
    c = sequence.camera
    u, v = np.meshgrid(np.arange(c.width) + 0.5, np.arange(c.height) + 0.5)
    length = np.sqrt(1 + ((u - c.cx) / c.fx) ** 2 + ((v - c.cy) / c.fy) ** 2)
    _, depth_m = box.render(box.pose_at(0.0))
    box.write_depth(tmp_path / "depth/000000.png", depth_m * length, 1000)
    frame = repaired(sequence, RepairConfig(depth_kind="ray"))[0]
    assert np.abs(frame.depth_m.numpy() - depth_m).max() < 1e-3


def test_shifts_in_time(tmp_path, box):
    sequence = folder(box.folder(tmp_path, n=5))
    later = repaired(sequence, RepairConfig(pose_shift_frames=1.5, rgb_shift_frames=-1))
    assert torch.allclose(
        later.pose(1),
        pose_between(sequence.pose(2), sequence.pose(3), 0.5),
        atol=1e-6,
    )
    frame = later[1]
    assert torch.equal(frame.rgb, sequence[0].rgb)
    assert torch.equal(frame.depth_m, sequence[1].depth_m)
    assert frame.index == 1
    with pytest.raises(
        BadFrameError,
        match=r"frame 3 has no pose: .* needs that of frame 4.5, expected one of 0 to 4",
    ):
        later.pose(3)
    with pytest.raises(BadFrameError, match=r"frame 0 has no colour: .* frame -1"):
        later[0]


def test_colour_is_moved_back(tmp_path, box):
    sequence = folder(box.folder(tmp_path, n=1))
    rgb = sequence[0].rgb.numpy()
    h, w = rgb.shape[:2]
    matrix = np.array([[0.9, 0, 0.1 * (w - 1) / 2 + 4], [0, 0.9, 0.1 * (h - 1) / 2 - 3]])
    moved = dataclasses.replace(
        sequence[0],
        rgb=torch.from_numpy(cv2.warpAffine(rgb, matrix, (w, h))),
    )

    class Moved:
        name = "moved"
        camera = sequence.camera

        def __len__(self):
            return 1

        def pose(self, i):
            return moved.T_WC

        def __getitem__(self, i):
            return moved

    repair = RepairConfig(rgb_shift_x_px=4.0, rgb_shift_y_px=-3.0, rgb_scale=0.9)
    back = repaired(Moved(), repair)[0].rgb.numpy()
    inner = np.s_[8:-8, 8:-8]
    assert np.abs(back - rgb)[inner].max() < 0.02
    mirrored = repaired(Moved(), RepairConfig(rgb_mirror="xy"))[0]
    assert torch.equal(mirrored.rgb, moved.rgb.flip((0, 1)))
    with pytest.raises(SequenceError, match=r"repair\.fit_sizes needs a recording on disk"):
        repaired(Moved(), RepairConfig(fit_sizes=True))


def test_sizes_are_fitted_to_depth(tmp_path, box):
    root = box.folder(
        tmp_path,
        n=2,
        width=128,
        height=96,
        fx=120.0,
        fy=116.0,
        cx=62.1,
        cy=49.3,
    )
    with pytest.raises(BadFrameError, match="expected 128x96, as the intrinsics say"):
        folder(root)[0]
    for f in (root / "rgb").iterdir():
        cv2.imwrite(
            str(f),
            cv2.resize(np.asarray(cv2.imread(str(f))), (96, 72)),
        )
    frame = open_sequence(root, data=DataConfig(repair=RepairConfig(fit_sizes=True)))[0]
    assert (frame.camera.width, frame.camera.height) == (64, 48)
    assert (frame.camera.fx, frame.camera.fy) == (60.0, 58.0)
    assert frame.rgb.shape == (48, 64, 3)
    assert box.off_wall_m(frame) < 0.002


def test_depth_of_another_view_is_not_fitted(tmp_path, box):
    root = box.folder(tmp_path, n=2)
    for f in (root / "depth").iterdir():
        cv2.imwrite(str(f), np.full((48, 48), 1000, np.uint16))
    with pytest.raises(
        SequenceError, match=r"48x48, but the intrinsics are for 64x48, of other proportions"
    ):
        open_sequence(root, data=DataConfig(repair=RepairConfig(fit_sizes=True)))


def test_frames_left_out_keep_their_numbers(tmp_path, box):
    root = box.folder(tmp_path, n=6)
    view = open_sequence(
        root,
        data=DataConfig(repair=RepairConfig(skip=(0, 3)), hold_out_every=2, hold_out_offset=0),
    )
    assert [f.index for f in view.mapping] == [2, 5]
    assert [f.index for f in view.held_out] == [1, 4]


def test_flags_name_what_differs():
    repair = RepairConfig(
        depth_factor=0.2, poses="world_to_camera", fit_sizes=True, skip=(3, 4), fx=525.25
    )
    assert repair.flags == (
        "--data.repair.depth-factor 0.2 --data.repair.poses world_to_camera "
        "--data.repair.fit-sizes --data.repair.fx 525.25 --data.repair.skip 3 4"
    )
    saved = to_dict(DataConfig(repair=repair))
    saved["repair"]["skip"] = [3, 4]  # as JSON gives it back
    assert from_dict(DataConfig, saved) == DataConfig(repair=repair)


@pytest.mark.parametrize("size", [(12, 16), (13, 17)])
def test_colour_is_scaled_about_the_middle_of_the_picture(generator, size):
    """So a picture that equals its mirror image does so afterwards, too."""
    half = torch.rand(*size, 3, generator=generator)
    symmetric = half + half.flip(0) + half.flip(1) + half.flip((0, 1))
    scaled = shifted_colour(symmetric, RepairConfig(rgb_scale=0.8))
    assert not torch.equal(scaled, symmetric)
    for axes in ((0,), (1,)):
        torch.testing.assert_close(scaled.flip(axes), scaled, atol=0.05, rtol=0)
