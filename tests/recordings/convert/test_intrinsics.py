"""Calibration files as other programs write them: what each means, and what is refused by name."""

import json

import cv2
import numpy as np
import pytest

from gsfusion_nb.data import SequenceError
from gsfusion_nb.recordings.convert.camera_numbers import doubt_of, model_of
from gsfusion_nb.recordings.convert.intrinsics import read_intrinsics

K = (208.5, 209.5, 159.0, 119.25)
BROWN = (0.26, -0.95, -0.005, 0.0026, 1.16)
FISHEYE = (0.01, -0.02, 0.003, -0.004)
SIZE = (320, 240)

ORB = """%YAML:1.0

# Camera calibration and distortion parameters (OpenCV)
Camera.type: "{type}"
Camera.fx: 208.5
Camera.fy: 209.5
Camera.cx: 159.0
Camera.cy: 119.25

Camera.k1: {k[0]}
Camera.k2: {k[1]}
{p}
Camera.width: 320
Camera.height: 240
Camera.fps: 30.0
Camera.bf: 40.0
Camera.RGB: 1
ThDepth: 40.0
DepthMapFactor: 5000.0
"""
ORB_BROWN = ORB.format(
    type="PinHole", k=BROWN, p="Camera.p1: -0.005\nCamera.p2: 0.0026\nCamera.k3: 1.16"
)
ORB_FISHEYE = ORB.format(type="KannalaBrandt8", k=FISHEYE, p="Camera.k3: 0.003\nCamera.k4: -0.004")
ORB_3 = (
    ORB_BROWN.replace("Camera.f", "Camera1.f")
    .replace("Camera.c", "Camera1.c")
    .replace("Camera.k", "Camera1.k")
)
ORB_3 = ORB_3.replace("Camera.p", "Camera1.p").replace("Camera1.fps", "Camera.fps")
KALIBR = """cam0:
  cam_overlaps: []
  camera_model: pinhole
  distortion_coeffs: {coefficients}
  distortion_model: {model}
  intrinsics: [208.5, 209.5, 159.0, 119.25]
  resolution: [320, 240]
  rostopic: /rgb
"""
ROS = """image_width: 320
image_height: 240
camera_name: rgb
camera_matrix:
  rows: 3
  cols: 3
  data: [208.5, 0, 159.0, 0, 209.5, 119.25, 0, 0, 1]
distortion_model: {model}
distortion_coefficients:
  rows: 1
  cols: {n}
  data: {coefficients}
rectification_matrix: {{rows: 3, cols: 3, data: [1, 0, 0, 0, 1, 0, 0, 0, 1]}}
projection_matrix:
  rows: 3
  cols: 4
  data: [200.0, 0, 160.0, 0, 0, 201.0, 120.0, 0, 0, 0, 1, 0]
"""
ROS_BROWN = ROS.format(model="plumb_bob", n=5, coefficients=list(BROWN))
OPENCV_HEAD = "%YAML:1.0\n---\n"
REALSENSE = {"width": 320, "height": 240, "fx": 208.5, "fy": 209.5, "ppx": 159.0, "ppy": 119.25}
OPEN3D = {
    "width": 320,
    "height": 240,
    "intrinsic_matrix": [208.5, 0, 0, 0, 209.5, 0, 159.0, 119.25, 1],
}
BUNDLE_FUSION = """m_versionNumber = 4
m_colorWidth = 320
m_colorHeight = 240
m_depthShift = 1000
m_calibrationColorIntrinsic = 208.5 0 159.0 0 0 209.5 119.25 0 0 0 1 0 0 0 0 1
"""


VINS = """%YAML:1.0
---
model_type: {model}
camera_name: camera
image_width: 320
image_height: 240
distortion_parameters:
   k1: 0.26
   k2: -0.95
   p1: -0.005
   p2: 0.0026
projection_parameters:
   fx: 208.5
   fy: 209.5
   cx: 159.0
   cy: 119.25
"""
NICE_SLAM = """cam:
  H: 240
  W: 320
  fx: 208.5
  fy: 209.5
  cx: 159.0
  cy: 119.25
  png_depth_scale: 6553.5
  crop_edge: 10
"""
PINHOLE = {"fx": 208.5, "fy": 209.5, "cx": 159.0, "cy": 119.25}


def opencv_yaml(path):
    """What OpenCV itself writes: numbers such as 2.0850000000000000e+02, and tagged matrices."""
    file = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    file.write("image_width", 320)
    file.write("image_height", 240)
    file.write(
        "camera_matrix",
        np.array([[K[0], 0, K[2]], [0, K[1], K[3]], [0, 0, 1]]),
    )
    file.write("distortion_coefficients", np.array([BROWN]))
    file.release()


@pytest.mark.parametrize(
    ("name", "text", "distortion", "fisheye"),
    [
        ("orb.yaml", ORB_BROWN, BROWN, False),
        ("orb.yaml", ORB_FISHEYE, FISHEYE, True),
        ("orb3.yaml", ORB_3, BROWN, False),
        (
            "camchain.yaml",
            KALIBR.format(coefficients=list(BROWN[:4]), model="radtan"),
            BROWN[:4],
            False,
        ),
        (
            "camchain.yaml",
            KALIBR.format(coefficients=list(FISHEYE), model="equidistant"),
            FISHEYE,
            True,
        ),
        ("ros.yaml", ROS_BROWN, BROWN, False),
        ("rtabmap.yaml", OPENCV_HEAD + ROS_BROWN, BROWN, False),
        (
            "fisheye.yaml",
            ROS.format(model="equidistant", n=4, coefficients=list(FISHEYE)),
            FISHEYE,
            True,
        ),
        ("opencv.yaml", opencv_yaml, BROWN, False),
        (
            "rs.json",
            json.dumps(REALSENSE | {"model": "distortion.brown_conrady", "coeffs": BROWN}),
            BROWN,
            False,
        ),
        ("rs.json", json.dumps(REALSENSE | {"model": 4, "coeffs": BROWN}), BROWN, False),
        (
            "rs.json",
            json.dumps(
                REALSENSE | {"model": "distortion.inverse_brown_conrady", "coeffs": [0] * 5}
            ),
            (),
            False,
        ),
        (
            "two.json",
            json.dumps({"depth": REALSENSE | {"fx": 145.6}, "color": REALSENSE}),
            (),
            False,
        ),
        ("open3d.json", json.dumps(OPEN3D), (), False),
        (
            "K.json",
            json.dumps({"K": [[K[0], 0, K[2]], [0, K[1], K[3]], [0, 0, 1]], "dist_coeffs": BROWN}),
            BROWN,
            False,
        ),
        ("vins.yaml", VINS.format(model="PINHOLE"), (*BROWN[:4], 0.0), False),
        ("slam.yaml", NICE_SLAM, (), False),
        (
            "text.yaml",
            ORB_3.replace("Camera1.k1", "Camera1.distortion")
            .replace(": 0.26\n", ": 0.26 -0.95 -0.005 0.0026\n")
            .replace("Camera1.k2: -0.95\n", "")
            .replace("Camera1.p1: -0.005\nCamera1.p2: 0.0026\nCamera1.k3: 1.16\n", ""),
            BROWN[:4],
            False,
        ),
        (
            "named.json",
            json.dumps(PINHOLE | {"distortion": "equidistant", "coeffs": FISHEYE}),
            FISHEYE,
            True,
        ),
        (
            "group.json",
            json.dumps(
                PINHOLE
                | {
                    "camera_type": "fisheye",
                    "distortion": dict(zip(("k1", "k2", "k3", "k4"), FISHEYE, strict=True)),
                }
            ),
            FISHEYE,
            True,
        ),
        (
            "whole.json",
            json.dumps(
                PINHOLE
                | {
                    "binning_x": 1,
                    "binning_y": 0,
                    "roi": {"x_offset": 0, "width": 320, "height": 0, "do_rectify": False},
                }
            ),
            (),
            False,
        ),
        ("lines.txt", "fx: 2.085e+02\nfy = 209.5\ncx 159.0, cy: 1.1925e2\n", (), False),
        (
            "sections.txt",
            "[rgb]\nfx 208.5\nfy 209.5\ncx 159\ncy 119.25\n[depth]\nfx 145.6\nfy 145.6\ncx 80\ncy "
            "60\n",
            (),
            False,
        ),
        ("info.txt", BUNDLE_FUSION, (), False),
        ("numbers.txt", "208.5 209.5 159.0 119.25 0.26 -0.95 -0.005 0.0026 1.16", BROWN, False),
        ("1_33.386.pincam", "320 240 208.5 209.5 159.0 119.25", (), False),
    ],
)
def test_what_other_programs_write(tmp_path, name, text, distortion, fisheye):
    path = tmp_path / name
    if callable(text):
        text(path)
    else:
        path.write_text(text)
    model = read_intrinsics(str(path), SIZE)
    camera = model.camera
    assert (camera.width, camera.height) == SIZE
    assert (camera.fx, camera.fy, camera.cx - 0.5, camera.cy - 0.5) == pytest.approx(K)
    assert model.distortion == pytest.approx(distortion)
    assert model.fisheye == fisheye


def test_a_size_in_the_file_counts(tmp_path):
    """ORB-SLAM's file of 320x240 beside images of 160x120: the focal length is half."""
    (tmp_path / "orb.yaml").write_text(ORB_BROWN)
    half = read_intrinsics(str(tmp_path / "orb.yaml"), (160, 120)).fitted(160, 120, "the image")
    assert (half.camera.fx, half.camera.cx) == pytest.approx((208.5 / 2, 159.5 / 2))


@pytest.mark.parametrize(
    ("name", "text", "why"),
    [
        (
            "two.yaml",
            "cam0: {fx: 1, fy: 1, cx: 1, cy: 1}\ncam1: {fx: 2, fy: 2, cx: 2, cy: 2}",
            "2 cameras, cam0, cam1",
        ),
        ("rs.json", json.dumps(REALSENSE | {"model": 2, "coeffs": BROWN}), "inverse_brown_conrady"),
        (
            "omni.yaml",
            KALIBR.format(coefficients=list(FISHEYE), model="fov"),
            "the lens 'fov' with other coefficients",
        ),
        ("lens.txt", "fx 208\nfy 208\ncx 159\ncy 119\nk9 0.5\n", "k9 = 0.5 changes the camera"),
        (
            "skew.json",
            json.dumps({"fx": 1, "fy": 1, "cx": 1, "cy": 1, "skew": 0.1}),
            "skew = 0.1 changes the camera",
        ),
        (
            "what.yaml",
            "focal: 525\nsensor: [1, 2]\n",
            "holds no camera in a way that is known, but 'focal, sensor'",
        ),
        ("vins.yaml", VINS.format(model="MEI"), "the lens 'mei' with other coefficients"),
        (
            "group.json",
            json.dumps(PINHOLE | {"distortion": {"model": "fov", "parameters": [0.9]}}),
            "distortion has 'model, parameters'",
        ),
        (
            "numbered.json",
            json.dumps(PINHOLE | {"k1": 0.1, "k2": 0.1, "k3": 0.1, "k4": 0.1}),
            "k1 to k4 without p1 and p2",
        ),
        ("half.json", json.dumps(PINHOLE | {"binning_x": 2}), "binning_x = 2 says"),
        ("dist.json", json.dumps(PINHOLE | {"dist": [0.1, 0, 0, 0]}), r"dist = \[0.1"),
        ("line.json", json.dumps(PINHOLE | {"k_1": 0.1}), "k_1 = 0.1 changes the camera"),
        ("cap.json", json.dumps(PINHOLE | {"K1": 0.1}), "K1 = 0.1 changes the camera"),
        (
            "lens.json",
            json.dumps(PINHOLE | {"lens_distortion": {"k1": 0.1}}),
            "lens_distortion = .* changes the camera",
        ),
        ("unit.json", json.dumps(PINHOLE | {"unit": "mm"}), "unit = 'mm' may say .* in pixels"),
        (
            "origin.json",
            json.dumps(PINHOLE | {"half_pixel_offset": True}),
            "half_pixel_offset = True may say where pixels are counted from",
        ),
        (
            "part.yaml",
            ROS_BROWN + "roi: {x_offset: 40, y_offset: 0, width: 240, height: 240}\n",
            "roi = .* a part of the sensor",
        ),
        (
            "cameras.txt",
            "# Camera list\n1 OPENCV 320 240 208.5 209.5 159 119.25 0.1 -0.2 0 0\n",
            "holds no camera in a way that is known, but '1 OPENCV 320 240",
        ),
        ("what.yaml", "- 1\n- 2\n", "holds no camera in a way that is known"),
        (
            "five.yaml",
            ROS.format(model="equidistant", n=5, coefficients=list(BROWN)),
            "must have the coefficients k1",
        ),
    ],
)
def test_what_would_change_the_camera_is_refused_by_name(tmp_path, name, text, why):
    path = tmp_path / name
    path.write_text(text)
    with pytest.raises(SequenceError, match=why) as error:
        read_intrinsics(str(path), SIZE)
    assert str(path) in str(error.value)
    assert "damaged" not in str(error.value)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("scale", 0.5),
        ("scale", [2, 2]),
        ("imageScale", 0.5),
        ("downscale_factor", 4),
        ("zoom", 1.5),
        ("rotation", 90),
        ("rotation", [0, -1, 0, 1, 0, 0, 0, 0, 1]),
        ("rotation", "cw"),
        ("orientation", 6),
        ("flip_horizontal", True),
        ("mirrored", 1.5),
        ("transposed", True),
        ("translation", [0.015, 0, 0]),
    ],
)
@pytest.mark.parametrize("is_group", [False, True])
def test_what_may_say_that_images_were_changed_is_refused_by_name(tmp_path, name, value, is_group):
    values = PINHOLE | {name: value}
    path = tmp_path / "calibration.json"
    path.write_text(json.dumps({"camera": values} if is_group else values))
    with pytest.raises(SequenceError, match=rf"calibration\.json: {name} = .*--intrinsics 'fx fy"):
        read_intrinsics(str(path), SIZE)


def test_what_says_that_images_were_not_changed_is_read(tmp_path):
    same = {
        "scale": 1.0,
        "image_scale": [1, 1],
        "rotation": [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
        "rotate": 0,
        "orientation": 1,
        "flipped": False,
        "mirror": None,
        "translation": [0, 0, 0],
    }
    (tmp_path / "c.json").write_text(json.dumps(PINHOLE | same))
    assert read_intrinsics(str(tmp_path / "c.json"), SIZE).camera.fx == PINHOLE["fx"]
    (tmp_path / "c.json").write_text(json.dumps(PINHOLE | {"scale": 6553.5}))  # unit of depth
    assert read_intrinsics(str(tmp_path / "c.json"), SIZE).camera.fx == PINHOLE["fx"]


def test_the_centre_of_the_first_pixel_is_spelled_in_two_ways(tmp_path):
    for name in ("pixel_centre", "pixel_center"):
        (tmp_path / "c.json").write_text(json.dumps(PINHOLE | {name: 0.5, "unit": "px"}))
        camera = read_intrinsics(str(tmp_path / "c.json"), SIZE).camera
        assert (camera.cx, camera.cy) == (PINHOLE["cx"], PINHOLE["cy"])


def test_comments_behind_values(tmp_path):
    lines = (f"{name}: {value} # pixels" for name, value in PINHOLE.items())
    (tmp_path / "camera.txt").write_text("\n".join(lines))
    assert read_intrinsics(str(tmp_path / "camera.txt"), SIZE).camera.fx == PINHOLE["fx"]


@pytest.mark.parametrize(
    ("values", "size", "reason"),
    [
        ((208.5, 209.5, 159.5, 119.5), (320, 240), ""),
        ((585.0, 585.0, 320.0, 240.0), (640, 480), ""),
        ((200.0, 200.0, 160.0, 150.0), (320, 240), ""),
        ((208.5, 209.5, 159.5, 119.5), (160, 120), "the principal point 160, 120 is far from"),
        ((208.5, 209.5, 159.5, 119.5), (640, 480), "the principal point 160, 120 is far from"),
        ((159.5, 119.5, 159.5, 119.5), (320, 240), "fx 159.5 and fy 119.5 differ"),
        ((60.0, 60.0, 159.5, 119.5), (320, 240), "fx 60 is unusual for a width of 320"),
    ],
)
def test_intrinsics_of_other_images_are_doubted(values, size, reason):
    doubt = doubt_of(model_of([*values], size, "it", centre=0.0).camera)
    assert reason in doubt
    assert bool(doubt) == bool(reason)
    assert not doubt or "(--intrinsics)" in doubt


@pytest.mark.parametrize("name", ["camera.yaml", "camera.txt"])
def test_a_name_that_is_a_value_and_a_group_is_one_sentence(tmp_path, name):
    (tmp_path / name).write_text("Camera: 1\nCamera.fx: 208.5\nCamera.fy: 209.5\n")
    with pytest.raises(SequenceError, match=name):
        read_intrinsics(str(tmp_path / name), SIZE)


def test_yaml_runs_no_code(tmp_path):
    (tmp_path / "camera.yaml").write_text(
        "fx: !!python/object/apply:os.system ['touch here']\nfy: 1\ncx: 1\ncy: 1\n"
    )
    with pytest.raises(SequenceError):
        read_intrinsics(str(tmp_path / "camera.yaml"), SIZE)


def test_the_camera_of_a_zed_is_the_left_one_of_the_images_size(tmp_path):
    sizes = {"2K": 1060.0, "FHD": 1058.0, "HD": 529.0, "VGA": 264.0}
    lines = []
    for side, more in (("LEFT", 0.0), ("RIGHT", 5.0)):
        for name, focal in sizes.items():
            lines += [
                f"[{side}_CAM_{name}]",
                f"fx={focal + more}",
                f"fy={focal + more}",
                "cx=600.5",
                "cy=350.5",
            ]
    (tmp_path / "SN1.conf").write_text("\n".join(lines))
    model = read_intrinsics(str(tmp_path / "SN1.conf"), (1280, 720))
    assert (model.camera.fx, model.camera.cx) == (529.0, 601.0)
    with pytest.raises(SequenceError, match="holds 8 cameras"):
        read_intrinsics(str(tmp_path / "SN1.conf"), (640, 360))
