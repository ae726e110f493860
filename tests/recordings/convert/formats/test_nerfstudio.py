"""transforms.json of nerfstudio and its relatives."""

import json
import math
from typing import Any

import cv2
import numpy as np
import pytest
import torch

from gsfusion_nb.data import SequenceError
from gsfusion_nb.recordings.convert import ConvertOptions, convert, detect_format

GL = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64))


def write_nerfstudio(root, takes, world=None, *, per_frame: Any = False, **changes):
    c = takes.camera
    world = torch.eye(4, dtype=torch.float64) if world is None else world
    own = {"fl_x": c.fx, "fl_y": c.fy, "cx": c.cx, "cy": c.cy, "w": c.width, "h": c.height}
    frames = []
    for i in (2, 0, 1, 3):
        takes.write(root / f"images/frame_{i + 8}.png", takes.png(i))
        takes.write(root / f"depth/frame_{i + 8}.png", takes.depth_png(i))
        frames.append(
            {
                "file_path": f"images/frame_{i + 8}.png",
                "depth_file_path": f"depth/frame_{i + 8}.png",
                "transform_matrix": (world @ takes.T_WC[i] @ GL).tolist(),
                **(own if per_frame else {}),
            }
        )
    values = {"camera_model": "OPENCV", **({} if per_frame else own), "k1": 0.0, "frames": frames}
    values = {k: v for k, v in (values | changes).items() if v is not None}
    (root / "transforms.json").write_text(json.dumps(values))
    return root


@pytest.mark.parametrize("per_frame", [False, True])
def test_reads_what_was_written(tmp_path, takes, per_frame):
    root = write_nerfstudio(tmp_path / "scan", takes, per_frame=per_frame)
    assert detect_format(root) == detect_format(root / "transforms.json") == "nerfstudio"
    convert(root, tmp_path / "out")
    takes.check(tmp_path / "out")


def test_depth_of_instant_ngp_and_nerfcapture(tmp_path, takes):
    """They call it depth_path, and may write names without suffix."""
    root = write_nerfstudio(tmp_path / "scan", takes)
    values = json.loads((root / "transforms.json").read_text())
    for frame in values["frames"]:
        frame["file_path"] = frame["file_path"].removesuffix(".png")
        frame["depth_path"] = frame.pop("depth_file_path").removesuffix(".png")
    (root / "transforms.json").write_text(json.dumps(values))
    convert(root, tmp_path / "out")
    takes.check(tmp_path / "out")


def test_images_outside_of_the_folder_are_told(tmp_path, takes):
    root = write_nerfstudio(tmp_path / "scan", takes)
    (root / "depth").rename(tmp_path / "depth")
    text = (root / "transforms.json").read_text()
    (root / "transforms.json").write_text(text.replace('"depth/', f'"{tmp_path}/depth/'))
    report = convert(root, tmp_path / "out")
    assert any(note.startswith("4 of the listed images lie outside of") for note in report.notes)
    takes.check(tmp_path / "out")


def test_is_fisheye_is_a_fisheye(tmp_path, takes):
    lens = {"k1": 0.02, "k2": -0.01, "k3": 0.003, "k4": -0.001}
    named = write_nerfstudio(tmp_path / "a", takes, **{"camera_model": "OPENCV_FISHEYE"} | lens)
    switched = write_nerfstudio(tmp_path / "b", takes, **{"is_fisheye": True} | lens)
    convert(named, tmp_path / "named")
    convert(switched, tmp_path / "switched")
    assert (tmp_path / "named/intrinsics.json").read_text() == (
        tmp_path / "switched/intrinsics.json"
    ).read_text()
    depth_files = [tmp_path / name / "depth/000001.png" for name in ("named", "switched")]
    assert depth_files[0].read_bytes() == depth_files[1].read_bytes() != takes.depth_png(1)


@pytest.mark.parametrize(
    "key", ["is_equirectangular", "ftheta_p0", "orthographic", "xi", "k5", "skew"]
)
def test_other_lenses_are_refused_by_name(tmp_path, takes, key):
    root = write_nerfstudio(tmp_path / "scan", takes, **{key: 1.0})
    with pytest.raises(SequenceError, match=f"has {key}, a lens that cannot be undistorted"):
        convert(root, tmp_path / "out")


def test_applied_transform_and_scale_are_undone(tmp_path, takes):
    A = torch.tensor(
        [[0, 1, 0, 0.3], [1, 0, 0, -0.2], [0, 0, -1, 0.1], [0, 0, 0, 1]],
        dtype=torch.float64,
    )
    scale = torch.diag(torch.tensor([2.5, 2.5, 2.5, 1.0], dtype=torch.float64))
    moved = write_nerfstudio(tmp_path / "a", takes, A, applied_transform=A[:3].tolist())
    convert(moved, tmp_path / "out")
    takes.check(tmp_path / "out")
    root = write_nerfstudio(
        tmp_path / "b", takes, A, applied_transform=A[:3].tolist(), applied_scale=2.5
    )
    values = json.loads((root / "transforms.json").read_text())
    for frame in values["frames"]:
        T = torch.tensor(frame["transform_matrix"], dtype=torch.float64)
        T[:, 3] = (scale @ T)[:, 3]
        frame["transform_matrix"] = T.tolist()
    (root / "transforms.json").write_text(json.dumps(values))
    report = convert(root, tmp_path / "scaled")
    takes.check(tmp_path / "scaled")
    assert "applied_scale 2.5 was undone" in report.notes


def test_field_of_view_instead_of_focal_length(tmp_path, takes):
    c = takes.camera
    angles = {
        f"camera_angle_{a}": 2 * math.atan(n / 2 / f)
        for a, n, f in (("x", c.width, c.fx), ("y", c.height, c.fy))
    }
    changes: dict = {"fl_x": None, "fl_y": None, "w": None, "h": None, **angles}
    root = write_nerfstudio(tmp_path / "scan", takes, **changes)
    convert(root, tmp_path / "out")
    takes.check(tmp_path / "out")


def test_numpy_depth_and_its_unit(tmp_path, takes):
    root = write_nerfstudio(tmp_path / "scan", takes, depth_unit_scale_factor=1.0)
    for i in range(4):
        np.save(root / f"depth/frame_{i + 8}.npy", takes.depth_m[i][..., None])
    text = (root / "transforms.json").read_text().replace("depth/frame_8.png", "depth/frame_8.npy")
    for i in range(9, 12):
        text = text.replace(f"depth/frame_{i}.png", f"depth/frame_{i}.npy")
    (root / "transforms.json").write_text(text)
    report = convert(root, tmp_path / "out")
    assert report.depth_scale == 1000
    takes.check(tmp_path / "out")


@pytest.mark.parametrize(
    "changes", [{"depth_type": "ray"}, {"depth_type": "Euclidean"}, {"is_euclidean_depth": True}]
)
def test_depth_along_the_ray_becomes_z_depth(tmp_path, takes, changes):
    root = write_nerfstudio(tmp_path / "scan", takes, depth_unit_scale_factor=1e-4, **changes)
    c = takes.camera
    u, v = np.meshgrid(np.arange(c.width) + 0.5, np.arange(c.height) + 0.5)
    per_z = np.sqrt(1 + ((u - c.cx) / c.fx) ** 2 + ((v - c.cy) / c.fy) ** 2)
    for i in range(4):
        stored = np.rint(takes.depth_m[i] * per_z * 1e4).astype(np.uint16)
        assert cv2.imwrite(str(root / f"depth/frame_{i + 8}.png"), stored)
    report = convert(root, tmp_path / "out")
    takes.check(tmp_path / "out")
    assert "depth read as 10000 per metre along the ray, and turned into z-depth" in report.notes


def test_each_frame_may_have_its_unit_of_depth(tmp_path, takes):
    root = write_nerfstudio(tmp_path / "scan", takes)
    values = json.loads((root / "transforms.json").read_text())
    for frame in values["frames"]:
        i = int(frame["file_path"].removesuffix(".png").split("_")[1]) - 8
        frame["depth_unit_scale_factor"] = [1e-4, 1e-3, 2e-4, 5e-4][i]
        takes.write(root / frame["depth_file_path"], takes.depth_png(i, (1e4, 1e3, 5e3, 2e3)[i]))
    (root / "transforms.json").write_text(json.dumps(values))
    report = convert(root, tmp_path / "out")
    takes.check(tmp_path / "out")
    assert "depth read as 1000 to 10000 per metre" in report.notes


@pytest.mark.parametrize("unit", [{"depth_scale": 5000}, {"depth_scale": 2e-4, "depth_type": "z"}])
def test_a_depth_scale_is_one_metre_or_one_unit(tmp_path, takes, unit):
    root = write_nerfstudio(tmp_path / "scan", takes, **unit)
    for i in range(4):
        takes.write(root / f"depth/frame_{i + 8}.png", takes.depth_png(i, 5000))
    convert(root, tmp_path / "out")
    takes.check(tmp_path / "out")


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"depth_type": "relative"}, "depth_type = 'relative' is not known; expected z, .* or ray"),
        ({"depth_type": "z", "is_euclidean_depth": True}, "contradict each other"),
        (
            {"depth_unit_scale_factor": 1e-3, "integer_depth_scale": 1e-4},
            "several units of depth, depth_unit_scale_factor 1000, integer_depth_scale 10000",
        ),
        ({"depth_unit_scale_factor": 0}, "depth_unit_scale_factor must be > 0"),
        ({"depth_offset": 0.5}, "depth_offset = 0.5 may change what the stored depth means"),
        ({"is_inverse_depth": True}, "is_inverse_depth = True may change"),
        ({"depth_min": 0.5, "depth_max": 10.0}, "depth_min = 0.5 may change"),
        ({"max_depth": 10.0}, "max_depth = 10.0 may change"),
        ({"is_log_depth": True}, "is_log_depth = True may change"),
        ({"depth_fl_x": 145.6}, "depth_fl_x = 145.6 may change"),
        ({"depth_to_color": [1.0]}, r"depth_to_color = \[1.0\] may change"),
    ],
)
def test_depth_of_another_meaning_is_refused_by_name(tmp_path, takes, changes, named):
    root = write_nerfstudio(tmp_path / "scan", takes, **changes)
    with pytest.raises(SequenceError, match=named):
        convert(root, tmp_path / "out")


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"coordinate_system": "opencv"}, "coordinate_system = 'opencv' may say .* OpenGL's axes"),
        ({"is_opengl": False}, "is_opengl = False may say"),
        ({"pose_convention": "w2c"}, "pose_convention = 'w2c' may say"),
        ({"invert_poses": True}, "invert_poses = True may say"),
        ({"units": "cm"}, "units = 'cm' may say that positions are not metres; .* --scale"),
        ({"scene_scale": 3.0}, "scene_scale = 3.0 may say"),
        ({"downscale_factor": 4}, "downscale_factor = 4 may say that images .* --intrinsics"),
        ({"rotation": 90}, "rotation = 90 may say that the images .* turned"),
    ],
)
def test_poses_and_images_of_another_meaning_are_refused_by_name(tmp_path, takes, changes, named):
    root = write_nerfstudio(tmp_path / "scan", takes, **changes)
    with pytest.raises(SequenceError, match=named):
        convert(root, tmp_path / "out")


@pytest.mark.parametrize(
    "changes",
    [
        {"is_opengl": True},
        {"coordinate_system": "OpenGL", "units": "metres", "scale_factor": 1},
        {"pose_convention": "camera-to-world", "world_to_camera": False, "orientation": None},
        {"scale": 0.33, "offset": [0.5, 0.5, 0.5], "aabb_scale": 16, "depth_count": 4},
    ],
)
def test_keys_that_say_what_is_read_anyway(tmp_path, takes, changes):
    convert(write_nerfstudio(tmp_path / "scan", takes, **changes), tmp_path / "out")
    takes.check(tmp_path / "out")


def test_what_the_options_answer_is_not_asked(tmp_path, takes):
    """A unit of the poses, and intrinsics of the images as stored."""
    c = takes.camera
    root = write_nerfstudio(tmp_path / "scan", takes, units="cm", downscale_factor=4)
    given = ConvertOptions(scale=1.0, intrinsics=f"{c.fx} {c.fy} {c.cx - 0.5} {c.cy - 0.5}")
    convert(root, tmp_path / "out", options=given)
    takes.check(tmp_path / "out")


def test_unknown_keys_are_named(tmp_path, takes):
    root = write_nerfstudio(
        tmp_path / "scan", takes, w=None, exposure=1.5, rolling_shutter=[0, 0, 1, 0], near=0
    )
    notes = "; ".join(convert(root, tmp_path / "out").notes)
    assert "keys that are not known and not used: exposure;" in notes
    assert "all rows have the pose of the frame" in notes
    assert "no w and h: the focal length is taken as that of the images" in notes


@pytest.mark.parametrize("key", ["file_path", "transform_matrix"])
def test_a_frame_without_its_image_or_pose_is_named(tmp_path, takes, key):
    root = write_nerfstudio(tmp_path / "scan", takes)
    values = json.loads((root / "transforms.json").read_text())
    values["frames"][2]["rotation"] = values["frames"][2].pop(key)
    (root / "transforms.json").write_text(json.dumps(values))
    with pytest.raises(SequenceError, match=f"frame 2 has no {key}, but .*rotation"):
        convert(root, tmp_path / "out")


def test_files_of_depth_beside_it_change_nothing(tmp_path, takes):
    names = {"mono_depth_file_path": "a.npy", "depth_scale_file": "b.txt", "depth_offset": 0}
    convert(write_nerfstudio(tmp_path / "scan", takes, **names), tmp_path / "out")
    takes.check(tmp_path / "out")


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"frames": []}, "depth_file_path"),
        ({"frames": [{"file_path": "a.png", "depth_file_path": "b.png"}]}, "transform_matrix"),
        ({"camera_model": "EQUIRECTANGULAR"}, "EQUIRECTANGULAR"),
        ({"fl_x": None}, "fl_x"),
        ({"k4": 0.1}, "k4"),
        (
            {
                "frames": [
                    {
                        "file_path": "frame_8.png",
                        "depth_file_path": "depth/frame_8.png",
                        "transform_matrix": [
                            [1, 0, 0, 0],
                            [0, 1, 0, 0],
                            [0, 0, 1, 0],
                            [0, 0, 2, 1],
                        ],
                    }
                ]
            },
            "last row 0 0 0 1, got 0 0 2 1",
        ),
        ({"applied_transform": [[2, 0, 0, 0], [0, 2, 0, 0], [0, 0, 2, 0]]}, "applied_transform"),
    ],
)
def test_bad_files(tmp_path, takes, changes, named):
    root = write_nerfstudio(tmp_path / "scan", takes, **changes)
    with pytest.raises(SequenceError, match=rf"transforms\.json.*{named}"):
        convert(root, tmp_path / "out")


def test_depth_elsewhere(tmp_path, takes):
    root = write_nerfstudio(tmp_path / "scan", takes)
    (root / "depth").rename(tmp_path / "elsewhere")
    convert(root, tmp_path / "out", options=ConvertOptions(depth=str(tmp_path / "elsewhere")))
    takes.check(tmp_path / "out")
