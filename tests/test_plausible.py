"""One set of limits: what no camera, pose or depth scale can be is refused by readers, converters
and mappers alike."""

import dataclasses
import json
from functools import partial

import pytest
import torch

from gsfusion_nb.data import SequenceError, open_sequence
from gsfusion_nb.data.lens import CameraModel
from gsfusion_nb.data.recorded.poses import checked_pose
from gsfusion_nb.geometry.operands import check_depth_scale, check_plausible_camera
from gsfusion_nb.recordings.convert.recording import RecordedFrame, Recording, RgbdImages
from gsfusion_nb.types import Camera

VGA = Camera(
    width=640,
    height=480,
    fx=525.0,
    fy=525.0,
    cx=320.0,
    cy=240.0,
)
WRONG = [
    ({"fx": 1e12}, "fx must be between 32 and 64000 for 640 x 480 pixels, got 1e"),
    ({"fx": 5.0, "fy": 5000.0}, "fx must be between 32 and 64000 for 640 x 480 pixels, got 5"),
    (
        {"fx": 100.0, "fy": 5000.0},
        "fx / fy must be between 0.1 and 10 for 640 x 480 pixels, got 0.02",
    ),
    ({"cx": 1e5}, "cx must be between -640 and 1280 for 640 x 480 pixels, got 100000"),
    ({"cy": -1000.0}, "cy must be between -480 and 960 for 640 x 480 pixels, got -1000"),
]
LAYOUT_KEYS = ("width", "height", "fx", "fy", "cx", "cy")


def no_images() -> RgbdImages:
    raise AssertionError("images are read after the camera was looked at")


@pytest.mark.parametrize(("change", "sentence"), WRONG)
def test_cameras_that_cannot_be(change, sentence, tmp_path):
    camera = dataclasses.replace(VGA, **change)
    with pytest.raises(ValueError, match=f"here: {sentence}"):
        check_plausible_camera("here", camera)
    with pytest.raises(SequenceError, match=f"shot 3: colour camera: {sentence}"):
        RecordedFrame(source="shot 3", time_s=None, model=CameraModel(camera), load=no_images)
    with pytest.raises(SequenceError, match=f"shot 3: depth camera: {sentence}"):
        RecordedFrame(
            source="shot 3",
            time_s=None,
            model=None,
            depth_model=CameraModel(camera),
            load=no_images,
        )
    write_scan(
        tmp_path,
        {name: getattr(camera, name) for name in LAYOUT_KEYS}
        | {"depth_scale": 1000, "pixel_centre": 0.5},
    )
    with pytest.raises(SequenceError, match=f"scan: camera: {sentence}"):
        open_sequence(tmp_path / "scan")


def write_scan(root, intrinsics):
    """As much of a recording as is looked at before its images."""
    for name in ("rgb", "depth"):
        (root / "scan" / name).mkdir(parents=True)
        (root / "scan" / name / "000000.png").write_bytes(b"x")
    (root / "scan/intrinsics.json").write_text(json.dumps(intrinsics))
    (root / "scan/poses.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1")


@pytest.mark.parametrize(
    ("scale", "sentence"), [(1e-3, "got 0.001; is it 1000, the inverse"), (1e9, r"got 1e\+09$")]
)
def test_depth_scales_that_cannot_be(scale, sentence, tmp_path):
    with pytest.raises(ValueError, match=f"must be between 1 and 1e.06, {sentence}"):
        check_depth_scale("here", scale)
    with pytest.raises(SequenceError, match=sentence):
        Recording(name="bag", frames=partial(iter, ()), n_frames=0, depth_scale=scale)
    write_scan(
        tmp_path, {name: getattr(VGA, name) for name in LAYOUT_KEYS} | {"depth_scale": scale}
    )
    with pytest.raises(SequenceError, match=sentence):
        open_sequence(tmp_path / "scan")


@pytest.mark.parametrize("metres", [1e6, -1e30])
def test_places_too_far_away(metres):
    T = torch.eye(4, dtype=torch.float64)
    T[2, 3] = metres
    with pytest.raises(
        SequenceError, match=r"poses.txt pose 4 must be within 10 km of the origin, got \(0, 0, "
    ):
        checked_pose(T, "poses.txt pose 4")
