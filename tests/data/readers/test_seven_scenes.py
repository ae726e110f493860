"""7-Scenes, as published and registered."""

import logging

import numpy as np
import pytest
import torch
from published_layouts import seven_scenes_layout as write

from gsfusion_nb.data import SequenceError, folder, open_sequence, seven_scenes
from gsfusion_nb.data.depth_registration import warp_depth
from gsfusion_nb.data.readers.seven_scenes import T_DEPTH_COLOUR
from gsfusion_nb.recordings.convert import ConvertOptions, convert
from gsfusion_nb.recordings.convert.formats import readable_layout
from gsfusion_nb.types import Camera


def test_depth_camera_as_published(tmp_path, box, caplog):
    with caplog.at_level(logging.WARNING, logger="gsfusion_nb"):
        seq = seven_scenes(write(tmp_path / "seq-01", box))
    assert "not registered" in caplog.text
    assert seq.camera == Camera(
        width=640,
        height=480,
        fx=585.0,
        fy=585.0,
        cx=320.5,
        cy=240.5,
    )
    frame = seq[1]
    assert not frame.depth_m[:10].any()
    assert (frame.depth_m[10:] > 0).all()
    assert torch.allclose(
        frame.T_WC.double(),
        box.poses(2)[1],
        atol=1e-6,
    )
    assert box.off_wall_m(frame) < 0.0005


@pytest.mark.parametrize("place", ["seq-01/camera.json", "camera-intrinsics.txt", "info.txt"])
def test_a_calibration_beside_the_images_counts(tmp_path, box, place):
    """3DMatch, BundleFusion and others have the names of 7-Scenes and a camera of their own."""
    root = write(tmp_path / "scene/seq-01", box)
    file = tmp_path / "scene" / place
    if file.suffix == ".json":
        file.write_text(
            '{"width": 640, "height": 480, "fx": 600, "fy": 601, "cx": 319.5, "cy": 239.5}'
        )
    elif file.name == "info.txt":
        file.write_text("m_calibrationColorIntrinsic = 600 0 319.5 0 0 601 239.5 0 0 0 1 0 0 0 0 1")
    else:
        file.write_text("600 0 319.5\n0 601 239.5\n0 0 1\n")
    assert readable_layout(root) == ""
    with pytest.raises(
        SequenceError, match=rf"a calibration of its own, .*{file.name}; it is read by"
    ):
        open_sequence(root)
    convert(root, tmp_path / "out", options=ConvertOptions(depth_scale=1000.0))
    assert (
        folder(tmp_path / "out").camera.fx,
        folder(tmp_path / "out").camera.fy,
    ) == pytest.approx((600, 601))
    own = Camera(
        width=640,
        height=480,
        fx=600.0,
        fy=601.0,
        cx=320.0,
        cy=240.0,
    )
    assert open_sequence(root, camera=own).source.camera == own
    file.unlink()
    assert readable_layout(root) == "seven_scenes"


def test_registered(tmp_path, box):
    seq = seven_scenes(write(tmp_path / "seq-01", box), register=True)
    frame = seq[1]
    assert torch.allclose(
        frame.T_WC.double(),
        box.poses(2)[1] @ T_DEPTH_COLOUR,
        atol=1e-6,
    )
    assert box.off_wall_m(frame) < 0.002  # warping rounds to whole pixels
    expected, _ = box.render(box.poses(2)[1] @ T_DEPTH_COLOUR, seq.camera)
    error = np.abs(frame.rgb.numpy() * 255 - expected)
    assert np.median(error) < 2  # k1 = -0.024 was not in the rendering, so corners differ a little
    assert 0.6 < float((frame.depth_m > 0).float().mean()) < 1


def test_warp_keeps_the_nearest_and_invents_nothing():
    camera = Camera(
        width=4,
        height=1,
        fx=1.0,
        fy=1.0,
        cx=2.0,
        cy=0.5,
    )
    depth_m = torch.tensor([[0.0, 2.0, 1.0, 0.0]])
    eye = torch.eye(4)
    assert torch.equal(warp_depth(depth_m, camera, camera, eye), depth_m)
    # everything falls into one pixel
    narrow = Camera(width=1, height=1, fx=0.2, fy=0.2, cx=0.5, cy=0.5)
    assert warp_depth(depth_m, camera, narrow, eye).tolist() == [[1.0]]
    nearer = eye.clone()
    nearer[2, 3] = -1.5  # what was at 1 m is now behind the target
    assert (
        warp_depth(
            depth_m,
            camera,
            Camera(width=40, height=1, fx=1.0, fy=1.0, cx=20.0, cy=0.5),
            nearer,
        ).sum()
        == 0.5
    )
    assert not warp_depth(torch.zeros(1, 4), camera, camera, eye).any()


def test_scene_folder_with_one_or_several_sequences(tmp_path, box):
    write(tmp_path / "chess" / "seq-01", box)
    assert len(seven_scenes(tmp_path / "chess")) == 2
    assert open_sequence(tmp_path / "chess").name == "seq-01"
    (tmp_path / "chess" / "seq-02").mkdir()
    with pytest.raises(
        SequenceError, match="chess holds several sequences; expected one of seq-01, seq-02"
    ):
        seven_scenes(tmp_path / "chess")


def test_calibration_is_a_rigid_transform_of_a_kinect():
    R = T_DEPTH_COLOUR[:3, :3]
    assert torch.allclose(
        R @ R.T,
        torch.eye(3, dtype=torch.float64),
        atol=1e-12,
    )
    assert 0.015 < float(T_DEPTH_COLOUR[:3, 3].norm()) < 0.03
