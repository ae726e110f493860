"""Recordings as the documentation of cameras, apps and data sets describes them: read right, or
refused by name.

The table is ``docs/formats.md``, and each of its rows is a test here.
"""

import re
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import recorded_kinds as kinds
import torch

from gsfusion_nb.data import SequenceError, folder
from gsfusion_nb.recordings.convert import ConvertOptions, convert

ALL = (0, 1, 2, 3)
WITHOUT_POSES = {"poses": "none"}


@dataclass(frozen=True)
class Kind:
    """A kind of recording, and what is right."""

    make: Callable[..., Path]
    says: str = ""
    """Pattern in the notes, or in the error where it is refused."""
    given: dict[str, Any] = field(default_factory=dict)
    """Options; the camera is given where the kind has none."""
    camera: bool = True
    """The kind tells the camera."""
    frames: tuple[int, ...] = ALL
    """Frames that are read; none where it is refused."""
    moved: bool = False
    """Depth is that of another camera, so its pixels are others."""


READ = {
    "StrayScanner, frames written": Kind(kinds.stray, r"depth of confidence 1 and above"),
    "Polycam": Kind(kinds.polycam, r"uncorrected images.*1000 per metre"),
    "Polycam, corrected": Kind(kinds.polycam_corrected, r"corrected images and cameras"),
    "3D Scanner App": Kind(kinds.scanner_app, r"3D Scanner App: depth read as 1000"),
    "ARKitScenes": Kind(kinds.arkitscenes, r"times read as s"),
    "Record3D": Kind(kinds.record3d, r"depth of confidence 1 and above"),
    "Azure Kinect by Open3D": Kind(kinds.azure_open3d, r"intrinsic\.json", WITHOUT_POSES),
    "RTAB-Map, exported": Kind(kinds.rtabmap_export, r"its column of frames says whose they are"),
    "ZED, exported": Kind(kinds.zed_export, r"1000 units a metre", WITHOUT_POSES, camera=False),
    "OAK, images with calib.json": Kind(kinds.oak_calibration, r"calib\.json", WITHOUT_POSES),
    "RealSense by rs-convert": Kind(
        kinds.realsense_convert, r"times were read as ms", WITHOUT_POSES, camera=False
    ),
    "ScanNet, exported": Kind(kinds.scannet_exported, r"1000 per metre", frames=(0, 2, 3)),
    "ScanNet, depth beside colour": Kind(
        kinds.scannet_extrinsic, r"50\.0 mm", frames=(0, 2, 3), moved=True
    ),
    "ScanNet, 25k frames": Kind(
        kinds.scannet_25k, r"depth from .*intrinsics_depth\.txt", moved=True
    ),
    "BundleFusion": Kind(
        kinds.bundlefusion, r"5000 units a metre, as m_depthShift of .*info\.txt says"
    ),
    "3DMatch": Kind(kinds.three_d_match, r"camera-intrinsics\.txt", moved=True),
    "SUN3D": Kind(kinds.sun3d, r"bits of depth were turned back"),
    "Redwood": Kind(kinds.redwood, camera=False),
    "ETH3D SLAM": Kind(kinds.eth3d, r"calibration\.txt"),
    "Bonn": Kind(kinds.bonn, r"5000 units a metre", camera=False),
    "CoRBS": Kind(kinds.corbs, r"groundtruth_H1\.txt", camera=False),
    "Neural RGB-D": Kind(
        kinds.neural_rgbd,
        r"from OpenGL's axes",
        camera=False,
        frames=(0, 1, 3),
    ),
    "TartanAir": Kind(kinds.tartanair, r"camera left; poses were turned", camera=False),
    "TartanAir V2": Kind(kinds.tartanair_2, r"camera lcam_front", camera=False),
    "BOP": Kind(kinds.bop, r"10000 per metre, as depth_scale"),
    "Replica of Semantic-NeRF": Kind(kinds.semantic_nerf, r"one pose per frame", camera=False),
    "Replica's camera, other names": Kind(
        kinds.nice_slam, r"6553\.5 units a metre, as scale of .*cam_params"
    ),
    "COLMAP, several cameras": Kind(kinds.colmap, r"no unit of length; one unit is taken as 1 m"),
    "nerfstudio": Kind(
        kinds.nerfstudio, r"applied_scale 0\.5 was undone.*masks are not used.*10000 per metre"
    ),
    "nerfstudio, fisheye cropped": Kind(
        kinds.nerfstudio_crop, r"fisheye_crop_radius is not used", moved=True
    ),
    "nerfstudio, depth along the ray": Kind(
        kinds.nerfstudio_ray, r"10000 per metre along the ray, and turned into z-depth"
    ),
    "poses that name images": Kind(kinds.named_poses, r"one pose per frame", camera=False),
    "poses with times, no header": Kind(
        kinds.poses_without_header,
        r"quaternions taken as x y z w; if w comes first: --pose-quaternions wxyz",
        camera=False,
    ),
    "Matterport3D": Kind(
        kinds.matterport,
        r"nothing proves it: 4000 would be .*--depth-scale",
        WITHOUT_POSES,
        camera=False,
        moved=True,
    ),
}
REFUSED = {
    "StrayScanner, as recorded": Kind(
        kinds.stray_video, r"rgb\.mp4 is a video.*ffmpeg -i rgb\.mp4"
    ),
    "Azure Kinect, raw calibration": Kind(
        kinds.k4a_calibration, r"raw calibration of an Azure Kinect", WITHOUT_POSES
    ),
    "Azure Kinect, .mkv": Kind(kinds.file_of("a.mkv"), r"azure_kinect_mkv_reader"),
    "RTAB-Map, database": Kind(
        kinds.rtabmap_database, r"RTAB-Map.*rtabmap-export --images_id --poses_camera"
    ),
    "RTAB-Map, poses of the robot": Kind(kinds.rtabmap_base_poses, r"robot's base.*--poses_camera"),
    "ZED, .svo2": Kind(kinds.file_of("a.svo2"), r"ZED_SVO_Export"),
    "ZED, calibration of other sizes": Kind(
        kinds.zed_calibration, r"holds 4 cameras, LEFT_CAM_2K", WITHOUT_POSES
    ),
    "RealSense, .db3": Kind(kinds.realsense_db3, r"RealSense SDK of 2026.*rs-convert"),
    "OpenNI, .oni": Kind(kinds.file_of("a.oni"), r"OpenNI"),
    "ElasticFusion, .klg": Kind(kinds.file_of("a.klg"), r"Kintinuous or ElasticFusion"),
    "Project Aria, .vrs": Kind(kinds.file_of("a.vrs"), r"no depth camera"),
    "ScanNet++, phone": Kind(kinds.scannetpp_iphone, r"pose_intrinsic_imu\.json.*toolbox"),
    "NYU Depth V2, raw": Kind(kinds.nyu_raw, r"swapped bytes"),
    "EuRoC and TUM-VI": Kind(kinds.euroc, r"grey cameras without depth"),
    "Hypersim": Kind(kinds.hypersim, r"HDF5 and the distance from the camera"),
    "AirSim": Kind(kinds.airsim, r"x forward, y right, z down"),
    "COLMAP, its own depth": Kind(kinds.colmap_own_depth, r"COLMAP's own.*not measured"),
    "nerfstudio, depth of another type": Kind(
        kinds.nerfstudio_relative, r"depth_type = 'relative' is not known; expected z, .* or ray"
    ),
    "a calibration with a scale": Kind(
        kinds.scaled_calibration, r"scale = 0\.5 may say .* scaled.*--intrinsics", WITHOUT_POSES
    ),
    "a calibration with a rotation": Kind(
        kinds.turned_calibration, r"rotation = 90 may say .* turned.*--intrinsics", WITHOUT_POSES
    ),
    "an archive": Kind(kinds.file_of("scan.zip"), r"unpack it first"),
    "a model": Kind(kinds.file_of("scan.usdz"), r"a model, not a recording"),
}

DOUBTED = {
    "times that count frames": (1.0, r"one frame in 1 s, but they are whole numbers"),
    "times in minutes": (1 / 15 / 60, r"in minutes it would be one in 0\.0667 s"),
    "times in milliseconds": (33.3, r"in ms it would be one in 0\.0333 s"),
}
"""Times of the plain layout: one frame in so many seconds, and what is said."""


def test_the_table_of_the_documentation_has_these_kinds():
    page = (Path(__file__).parents[3] / "docs/formats.md").read_text()
    read, refused, doubted = (
        re.findall(r"^\| (.+?) \|", part, re.MULTILINE)
        for part in re.split("Refused, by name|Opened, and doubted|## Numbers that", page)[:3]
    )
    assert [name for name in doubted if name != "kind"] == list(DOUBTED)
    assert [name for name in read if name != "kind"] == list(READ)
    assert [name for name in refused if name != "kind"] == list(REFUSED)


def test_each_test_that_the_documentation_names_is_there():
    """In the table of what was taken for something else."""
    root = Path(__file__).parents[3]
    page = (root / "docs/formats.md").read_text().split("## Numbers that")[1]
    named = re.findall(r"`(tests/[\w/]+\.py)::(\w+)`", page)
    assert len(named) > 60
    for file, test in named:
        assert f"def {test}(" in (root / file).read_text(), (file, test)


@pytest.mark.parametrize("name", READ)
def test_what_is_read(tmp_path, takes, name):
    kind = READ[name]
    c = takes.camera
    given = dict(kind.given)
    if not kind.camera:
        given["intrinsics"] = f"{c.fx} {c.fy} {c.cx - 0.5} {c.cy - 0.5}"
    source = kind.make(tmp_path / "scan", takes)
    report = convert(source, tmp_path / "out", options=ConvertOptions(**given))
    assert re.search(kind.says, "; ".join(report.notes)), report.notes
    assert report.has_poses == (kind.given != WITHOUT_POSES)
    sequence = folder(tmp_path / "out", poses=report.has_poses)
    assert len(sequence) == len(kind.frames)
    if not kind.moved:
        assert vars(sequence.camera) == pytest.approx(vars(c), abs=1e-4)
    for frame, i in zip(sequence, kind.frames, strict=True):
        if report.has_poses:
            assert torch.allclose(frame.T_WC.double(), takes.T_WC[i], atol=1e-5)
        if not kind.moved:
            assert np.abs(frame.depth_m.numpy() - takes.depth_m[i]).max() <= 5.1e-4


@pytest.mark.parametrize("name", REFUSED)
def test_what_is_refused_by_name(tmp_path, takes, name):
    kind = REFUSED[name]
    source = kind.make(tmp_path / "scan", takes)
    with pytest.raises(SequenceError, match=kind.says):
        convert(source, tmp_path / "out", options=ConvertOptions(**kind.given))
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("name", DOUBTED)
def test_what_is_doubted(tmp_path, takes, name):
    step, says = DOUBTED[name]
    convert(kinds.nerfstudio(tmp_path / "scan", takes), tmp_path / "out")
    lines = [f"{i:06d} {step * i}" for i in range(len(takes))]
    (tmp_path / "out/times.txt").write_text("\n".join(lines))
    doubt = folder(tmp_path / "out").doubtful_times
    assert doubt is not None
    assert re.search(says, doubt.sentence)
    assert folder(tmp_path / "out", times=False).doubtful_times is None


def test_the_largest_number_of_16_bits_is_no_distance(tmp_path, takes):
    """3DMatch's copies of 7-Scenes keep 65535, which would be 65.5 m."""
    convert(kinds.three_d_match(tmp_path / "scan", takes), tmp_path / "out")
    for i, frame in enumerate(folder(tmp_path / "out")):
        depth_m = frame.depth_m.numpy()
        assert not depth_m[:4, :5].any()
        assert np.abs(depth_m - takes.depth_m[i])[4:].max() <= 5.1e-4


def test_a_pose_of_polycam_without_its_position_is_refused(tmp_path, takes):
    root = kinds.polycam(tmp_path / "scan", takes)
    file = root / "keyframes/cameras/2000.json"
    values = kinds.json.loads(file.read_text())
    del values["t_03"], values["t_23"]
    file.write_text(kinds.json.dumps(values))
    with pytest.raises(SequenceError, match=r"2000\.json lacks t_03, t_23; expected"):
        convert(root, tmp_path / "out")


def test_depth_of_a_camera_beside_colour_is_where_a_sens_file_puts_it(tmp_path, takes):
    """The folders of ScanNet's exporter say what its .sens file says, so both become the same
    images."""
    convert(kinds.scannet_extrinsic(tmp_path / "scan", takes), tmp_path / "out")
    frame = folder(tmp_path / "out")[0]
    fx = takes.camera.fx
    z = takes.depth_m[0]
    row = 20
    # a point at u is seen 5 cm to the right of there
    moved = np.arange(z.shape[1]) + 0.5 + fx * 0.05 / z[row]
    found = frame.depth_m.numpy()[row]
    inside = moved < z.shape[1] - 1
    near = np.array(
        [
            np.abs(found[max(0, int(u) - 1) : int(u) + 2] - d).min()
            for u, d in zip(moved, z[row], strict=True)
        ]
    )
    assert np.median(near[inside]) < 2e-3


def test_doubtful_pixels_are_left_out(tmp_path, takes):
    root = kinds.stray(tmp_path / "scan", takes)
    levels = np.full(takes.depth_m[0].shape, 2, np.uint8)
    levels[:10] = 0
    levels[10:20] = 1
    for i in range(len(takes)):
        takes.write(
            root / f"confidence/{i:06d}.png", kinds.cv2.imencode(".png", levels)[1].tobytes()
        )
    for least, first_row in ((0, 0), (1, 10), (2, 20)):
        convert(root, tmp_path / f"out{least}", options=ConvertOptions(confidence=least))
        depth_m = folder(tmp_path / f"out{least}")[0].depth_m.numpy()
        assert not depth_m[:first_row].any()
        assert np.count_nonzero(depth_m[first_row:]) == np.count_nonzero(
            takes.depth_m[0][first_row:]
        )
