"""TUM RGB-D: association, pose interpolation, calibration, undistortion."""

import logging

import numpy as np
import pytest
import torch
from published_layouts import TUM_START_S as T0
from published_layouts import tum_layout as write

from gsfusion_nb.config import DataConfig, GSFusionConfig, RepairConfig
from gsfusion_nb.config.parts import TrackingConfig
from gsfusion_nb.data import SequenceError, open_sequence, tum
from gsfusion_nb.data.adjust.depth_agreement import depth_agreement
from gsfusion_nb.data.lens import CameraModel, Undistorter
from gsfusion_nb.data.readers.tum import LENSES
from gsfusion_nb.data.recorded.images import read_depth
from gsfusion_nb.types import Camera


def test_reads_what_was_written(tmp_path, box):
    seq = tum(write(tmp_path / "scan", box), camera=box.camera)
    assert len(seq) == 4
    assert seq.camera == box.camera
    for i, frame in enumerate(seq):
        t = 0.112 + i / 30
        assert frame.timestamp_s == pytest.approx(T0 + t, abs=1e-5)  # the colour image's time
        # the pose at that time, between two records
        assert torch.allclose(frame.T_WC.double(), box.pose_at(t), atol=2e-5)
    same = tum(write(tmp_path / "same", box, rgb_lag=0.0), camera=box.camera)
    assert all(box.off_wall_m(frame) < 0.0002 for frame in same)
    opened = open_sequence(tmp_path / "same", camera=box.camera)
    assert all(
        torch.equal(a.depth_m, b.depth_m) and torch.equal(a.T_WC, b.T_WC)
        for a, b in zip(opened, same, strict=True)
    )


def test_depth_has_the_pose_of_its_own_time(tmp_path, box):
    camera = box.camera.resized(8 * box.camera.width, 8 * box.camera.height)
    root = write(tmp_path / "scan", box, n=6, rgb_lag=0.016, camera=camera)
    asked = {"own": RepairConfig(), "as one": RepairConfig(depth_pose="colour")}
    read = {
        name: open_sequence(root, camera=camera, data=DataConfig(repair=r))
        for name, r in asked.items()
    }
    error_m = {name: max(box.off_wall_m(frame) for frame in seq) for name, seq in read.items()}
    assert error_m["own"] < error_m["as one"] / 4
    for a, b in zip(*read.values(), strict=True):
        assert torch.equal(a.T_WC, b.T_WC)
        assert torch.equal(a.colour, b.colour)


def test_a_late_depth_camera(tmp_path, box):
    """Depth images are listed 30 ms after they were taken: each belongs to the picture before its
    own."""
    root = write(tmp_path / "scan", box, n=6, rgb_lag=0.0)
    (root / "depth.txt").write_text(
        "\n".join(f"{T0 + 0.13 + i / 30:.6f} depth/{T0 + 0.1 + i / 30:.6f}.png" for i in range(6))
    )
    late, mended = (
        open_sequence(
            root, camera=box.camera, data=DataConfig(repair=RepairConfig(depth_offset_s=offset_s))
        )
        for offset_s in (0.0, -0.03)
    )
    assert (
        max(box.off_wall_m(frame) for frame in mended)
        < min(box.off_wall_m(frame) for frame in late) / 4
    )
    true = tum(root, camera=box.camera)
    stored = torch.from_numpy(read_depth(true.depth_files[3], scale=5000.0))
    assert torch.allclose(mended[2].depth_m, stored, atol=1e-4)


def test_tracking_does_not_know_how_the_camera_moved_between_picture_and_depth():
    assert (
        GSFusionConfig(tracking=TrackingConfig(poses="tracked")).data.repair.depth_pose == "colour"
    )
    assert GSFusionConfig().data.repair.depth_pose == "own"


def test_a_copy_with_only_some_of_the_images(tmp_path, box):
    root = write(tmp_path / "scan", box)
    whole = tum(root, camera=box.camera)
    for file in (*whole.rgb_files[::2], *whole.depth_files[:1]):
        file.unlink()
    part = tum(root, camera=box.camera)
    assert part.timestamps_s == whole.timestamps_s[1::2]
    assert part.rgb_files == whole.rgb_files[1::2]
    for file in (root / "rgb").iterdir():
        file.unlink()
    with pytest.raises(SequenceError, match=r"rgb\.txt names no image that is there"):
        tum(root, camera=box.camera)


@pytest.mark.parametrize(
    ("folder", "expected"),
    [
        ("rgbd_dataset_freiburg1_desk", (517.3, 516.5, 318.6, 255.3)),
        ("fr2_xyz", (520.9, 521.0, 325.1, 249.7)),
        ("rgbd_dataset_freiburg3_long_office_household", (535.4, 539.2, 320.1, 247.6)),
    ],
)
def test_calibration_by_folder_name(tmp_path, box, folder, expected):
    seq = tum(write(tmp_path / folder, box), undistort=False)
    fx, fy, cx, cy = expected
    assert seq.camera == Camera(
        width=640,
        height=480,
        fx=fx,
        fy=fy,
        cx=cx + 0.5,
        cy=cy + 0.5,
    )


def test_unknown_camera(tmp_path, box):
    root = write(tmp_path / "office", box)
    with pytest.raises(
        SequenceError,
        match="office: the folder's name holds none of freiburg1, freiburg2, freiburg3",
    ):
        tum(root)
    with pytest.raises(SequenceError, match="no TUM camera 'freiburg9'; known: freiburg1"):
        tum(root, camera="freiburg9")
    assert tum(root, camera="freiburg3").camera.fx == 535.4
    other = write(tmp_path / "freiburg1_office", box)
    (other / "calibration.txt").write_text("500 500 320 240\n")
    with pytest.raises(SequenceError, match="it has a calibration file"):
        tum(other)


def test_frames_without_colour_or_pose_are_dropped(tmp_path, box, caplog):
    root = write(tmp_path / "scan", box, n=8, gt_end=0.31)
    lines = (root / "rgb.txt").read_text().splitlines()
    (root / "rgb.txt").write_text("\n".join(line for k, line in enumerate(lines) if k != 3))
    with caplog.at_level(logging.WARNING, logger="gsfusion_nb"):
        seq = tum(root, camera=box.camera)
    assert [round(t - T0, 3) for t in seq.timestamps_s] == [0.112, 0.179, 0.212, 0.245, 0.279]
    assert "dropped 1 depth images without colour and 2 without pose" in caplog.text


def test_gaps_in_the_trajectory(tmp_path, box):
    with pytest.raises(
        SequenceError,
        match=r"none of 4 depth images has .* within 0\.02 s and poses .* 0\.2 s apart",
    ):
        tum(write(tmp_path / "a", box, gt_step=0.25), camera=box.camera)
    with pytest.raises(SequenceError, match="none of 1 depth images"):
        tum(
            write(tmp_path / "b", box, n=1, rgb_lag=0.0215),
            camera=box.camera,
        )
    root = write(tmp_path / "c", box)
    lines = (root / "groundtruth.txt").read_text().splitlines()
    lines[12] = f"{T0 + 0.113:.4f}" + " nan" * 7  # lost for one record: bridged
    (root / "groundtruth.txt").write_text("\n".join(lines))
    assert torch.allclose(
        tum(root, camera=box.camera).pose(0).double(),
        box.pose_at(0.112),
        atol=2e-4,
    )


def test_two_measurements_of_one_pose(tmp_path, box, caplog):
    """The published ground truth of freiburg2_desk has two rows of one time, 1.2 mm apart: the
    first counts."""
    root = write(tmp_path / "scan", box)
    same = tum(root, camera=box.camera)
    file = root / "groundtruth.txt"
    lines = file.read_text().splitlines()
    time, x, *rest = lines[12].split()
    lines.insert(13, " ".join([time, f"{float(x) + 0.0012:.9f}", *rest]))
    file.write_text("\n".join(lines))
    with caplog.at_level(logging.WARNING):
        again = tum(root, camera=box.camera)
    assert torch.equal(again.poses, same.poses)
    assert "1 row has the time of another row" in caplog.text
    assert "1.2 mm" in caplog.text
    lines[13] = " ".join([time, f"{float(x) + 0.5:.9f}", *rest])
    file.write_text("\n".join(lines))
    with pytest.raises(
        SequenceError, match=r"two poses at the time .*, 0\.5 m and 0 degrees apart"
    ):
        tum(root, camera=box.camera)


@pytest.mark.parametrize(
    ("name", "line"),
    [
        ("rgb", "hello rgb/1.png"),
        ("depth", "123.4"),
        ("depth", "nan depth/1.png"),
        ("rgb", "# nothing"),
        ("groundtruth", "1 2 3"),
        ("groundtruth", f"{T0} 0 0 0 0 0 0 2\n{T0 + 0.15} 0 0 0 0 0 0 2"),
    ],
)
def test_damaged_lists(tmp_path, box, name, line):
    root = write(tmp_path / "scan", box)
    (root / f"{name}.txt").write_text(line + "\n")
    with pytest.raises(SequenceError, match=rf"{name}\.txt"):
        tum(root, camera=box.camera)


def brown(xy, k1, k2, p1, p2, k3):
    """Brown's distortion of normalised coordinates, written out."""
    x = xy[..., 0]
    y = xy[..., 1]
    r2 = x * x + y * y
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    return np.stack(
        [
            x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
            y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
        ],
        -1,
    )


def test_undistortion_follows_the_lens_model_and_leaves_no_border():
    camera = Camera(
        width=160,
        height=120,
        fx=130.0,
        fy=128.0,
        cx=80.2,
        cy=63.0,
    )
    distortion = (0.2624, -0.9531, -0.0054, 0.0026, 1.1633)
    undistorter = Undistorter(CameraModel(camera, distortion))
    new = undistorter.camera
    # what the lens shows at source pixel (u, v): colour encodes the place, depth too
    u, v = np.meshgrid(np.arange(160), np.arange(120))
    rgb = np.stack([u, v, np.full_like(u, 255)], -1).astype(np.uint8)
    depth_m = (1.0 + u + 1000.0 * v).astype(np.float32)
    out_rgb = undistorter.colour(rgb)
    out_depth = undistorter.depth(depth_m)
    xy = np.stack(
        [(u + 0.5 - new.cx) / new.fx, (v + 0.5 - new.cy) / new.fy],
        -1,
    )
    d = brown(xy, *distortion)
    source_u = d[..., 0] * camera.fx + camera.cx - 0.5
    source_v = d[..., 1] * camera.fy + camera.cy - 0.5
    assert np.abs(out_rgb[..., 0] - source_u)[2:-2, 2:-2].max() < 1.1
    assert np.abs(out_rgb[..., 1] - source_v)[2:-2, 2:-2].max() < 1.1
    assert (out_rgb[..., 2] == 255).all()
    assert (out_depth > 0).all()
    assert np.isin(out_depth, depth_m).all()  # never interpolated
    near_u = (out_depth - 1) % 1000
    assert np.abs(near_u - source_u).max() < 0.6
    assert 0.9 < camera.fx / new.fx < 1.0


def test_fr1_images_are_consistent_only_when_undistorted(tmp_path, box):
    """Render through the fr1 lens, both colour and depth in the distorted pixels, as the Kinect's
    driver gives them."""
    root = write(tmp_path / "freiburg1_box", box, n=2, rgb_lag=0.0)
    lens = LENSES["freiburg1"]
    c = lens.camera
    ideal = Camera(
        width=800,
        height=640,
        fx=517.3,
        fy=516.5,
        cx=400.0,
        cy=320.0,
    )
    u, v = np.meshgrid(np.arange(640) + 0.5, np.arange(480) + 0.5)
    target = np.stack(
        [(u - c.cx) / c.fx, (v - c.cy) / c.fy],
        -1,
    )
    xy = target.copy()
    for _ in range(60):
        # fixed point: the ray that the lens bends to this pixel
        xy += target - brown(xy, *lens.distortion)
    x = np.clip(
        (xy[..., 0] * ideal.fx + ideal.cx).astype(int),
        0,
        799,
    )
    y = np.clip(
        (xy[..., 1] * ideal.fy + ideal.cy).astype(int),
        0,
        639,
    )
    for i, (rgb_file, depth_file) in enumerate(
        zip(
            sorted((root / "rgb").iterdir()),
            sorted((root / "depth").iterdir()),
            strict=True,
        )
    ):
        rgb, depth_m = box.render(box.pose_at(0.1 + i / 30), ideal)
        box.write_rgb(rgb_file, rgb[y, x])
        box.write_depth(depth_file, depth_m[y, x], 5000)
    on = tum(root)
    off = tum(root, undistort=False)
    assert box.off_wall_m(on[1]) < 0.002
    assert box.off_wall_m(off[1]) > 0.005
    # two roundings to whole pixels on slanted walls
    assert depth_agreement(on[0], on[1]).median_m < 0.003
