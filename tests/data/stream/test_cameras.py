import importlib.util
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from gsfusion_nb.data.stream import AzureKinect, BackgroundFrames, CameraNotFoundError, RealSense
from gsfusion_nb.data.stream.cameras import _SIZES
from gsfusion_nb.types import Frame

_spec = importlib.util.spec_from_file_location("fake_drivers", Path(__file__).with_name("fake_drivers.py"))
assert _spec is not None
assert _spec.loader is not None
fake_drivers = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(fake_drivers)

KINDS = ("realsense", "kinect")


class Device:
    """A fake camera of either kind that shows the box room."""

    def __init__(self, box, kind, monkeypatch):
        self.box, self.kind, self.monkeypatch = box, kind, monkeypatch
        monkeypatch.setitem(_SIZES, "720P", (box.camera.width, box.camera.height))
        self.pictures = [box.render(T) for T in box.poses(4)]

    def plugged(self, plan, coeffs=(0.0,) * 8, **options):
        """Plug it in; ``plan`` is what its driver gives."""
        c = self.box.camera
        self.replay = fake_drivers.Replay(
            self.pictures, plan, K=(c.fx, c.fy, c.cx - 0.5, c.cy - 0.5), size=(c.width, c.height), coeffs=coeffs
        )
        make = fake_drivers.realsense if self.kind == "realsense" else fake_drivers.kinect
        module = make(self.replay, **options)
        self.monkeypatch.setitem(sys.modules, "pyrealsense2" if self.kind == "realsense" else "pyk4a", module)
        return self

    def camera(self, **options):
        options = {"warm_up": 0, "timeout_s": 0.5, **options}
        if self.kind == "realsense":
            return RealSense(width=self.box.camera.width, height=self.box.camera.height, **options)
        return AzureKinect(**options)


@pytest.fixture(params=KINDS)
def device(request, box, monkeypatch):
    return Device(box, request.param, monkeypatch)


def some(camera, n: int) -> list[Frame]:
    frames = iter(camera)
    found = [next(frames) for _ in range(n)]
    frames.close()
    return found


def test_frames_are_those_that_the_device_saw(device, box):
    camera = device.plugged([0, 1, 2, 3]).camera()
    frames = some(camera, 4)
    for i, frame in enumerate(frames):
        assert frame.index == i
        assert frame.camera == camera.camera
        torch.testing.assert_close(frame.rgb, torch.from_numpy(device.pictures[i][0] / 255).float())
        assert float((frame.depth_m - torch.from_numpy(device.pictures[i][1])).abs().max()) < 0.00051
        torch.testing.assert_close(frame.T_WC, torch.eye(4))
    steps = np.diff([f.timestamp_s for f in frames])
    np.testing.assert_allclose(steps, 1 / 30, atol=1e-5)
    assert not camera.has_poses
    assert camera.policy == "latest"


def test_pixel_centres_are_ours(device, box):
    """The fake's intrinsics count centres from 0; points lie on the walls only if half a pixel is added."""
    import dataclasses

    camera = device.plugged([0]).camera()
    [frame] = some(camera, 1)
    # 32-bit floats of the camera's principal point
    assert frame.camera.cx == pytest.approx(box.camera.cx)
    assert frame.camera.cy == pytest.approx(box.camera.cy)
    there = dataclasses.replace(frame, T_WC=box.poses(1)[0].float())
    assert box.off_wall_m(there) < 0.001


def test_the_first_frames_are_thrown_away(device):
    [frame] = some(device.plugged([0, 0, 0, 1, 2]).camera(warm_up=3), 1)
    assert frame.index == 0
    torch.testing.assert_close(frame.rgb, torch.from_numpy(device.pictures[1][0] / 255).float())


def test_incomplete_frames_and_single_timeouts_are_counted_and_passed_over(device):
    plan = [0, "timeout", "no depth", 1, "timeout", "timeout", "no colour", 2, "unplug"]
    camera = device.plugged(plan).camera()
    frames = list(camera)
    assert [f.index for f in frames] == [0, 1, 2]
    assert (camera.n_timeouts, camera.n_incomplete) == (3, 2)


def test_unplugged_in_the_middle_it_ends_and_says_why(device):
    camera = device.plugged([0, 1, "unplug"]).camera()
    with BackgroundFrames(camera) as frames:
        assert [f.index for f in frames] == [0, 1]
    assert "was disconnected" in camera.broke_off
    assert device.replay.log.count("stopped") == 1


def test_a_silent_camera_is_given_up(device):
    camera = device.plugged([0, "timeout"]).camera()
    assert len(list(camera)) == 1
    assert camera.broke_off == f"{device.kind} gave no frame for 2.5 s"
    assert camera.n_timeouts == 5


def test_a_driver_that_is_not_installed_names_the_extra(device, monkeypatch):
    monkeypatch.setitem(sys.modules, "pyrealsense2" if device.kind == "realsense" else "pyk4a", None)
    with pytest.raises(CameraNotFoundError, match=rf"pip install 'gsfusion-nb\[{device.kind}\]'"):
        next(iter(device.camera()))


def test_lens_distortion_is_removed_from_both_images(device, box):
    """Pictures of a distorting lens, made by warping the pinhole's; undistorted they show the walls where they are."""
    import cv2

    c, k = box.camera, np.array([0.4, -0.1, 0.01, -0.01, 0.05])
    K = np.array([[c.fx, 0, c.cx - 0.5], [0, c.fy, c.cy - 0.5], [0, 0, 1]])
    uv = np.stack(np.meshgrid(np.arange(c.width), np.arange(c.height)), -1).reshape(-1, 1, 2).astype(np.float64)
    ideal = cv2.undistortPoints(uv, K, k, P=K).reshape(c.height, c.width, 2).astype(np.float32)
    T = box.poses(1)[0]
    rgb, depth_m = box.render(T)
    device.pictures = [tuple(cv2.remap(x, ideal[..., 0], ideal[..., 1], cv2.INTER_LINEAR) for x in (rgb, depth_m))]
    coeffs = (*k, 0.0, 0.0, 0.0)

    def off(**options) -> tuple[float, float]:
        """Mean difference from what a pinhole with the frame's intrinsics sees: colour 0..1, depth in metres."""
        [frame] = some(device.plugged([0], coeffs).camera(**options), 1)
        rgb, depth_m = box.render(T, frame.camera)
        colour = (frame.rgb - torch.from_numpy(rgb / 255)).abs().mean()
        return float(colour), float((frame.depth_m - torch.from_numpy(depth_m)).abs().mean())

    (colour, depth_m), (colour_before, depth_before_m) = off(), off(undistort=False)
    assert 10 * colour < colour_before
    assert 3 * depth_m < depth_before_m  # taken from the nearest pixel, which is up to half a pixel off


def test_realsense_streams_and_filters(box, monkeypatch):
    device = Device(box, "realsense", monkeypatch).plugged([0])
    some(device.camera(filters=("hole_filling", "temporal", "decimation"), fps=15), 1)
    assert device.replay.log[:3] == [
        ("device", "123"), ("color", 64, 48, "rgb8", 15), ("depth", 64, 48, "z16", 15),
    ]  # fmt: skip
    order = ["decimation", ("disparity", True), "temporal", ("disparity", False), "hole_filling", ("align", "color")]
    assert device.replay.log[3:9] == order
    with pytest.raises(KeyError, match="no RealSense filter 'median'"):
        device.camera(filters=("median",))


def test_kinect_settings(box, monkeypatch):
    device = Device(box, "kinect", monkeypatch).plugged([0])
    some(device.camera(fps=15, depth_mode="WFOV_UNBINNED"), 1)
    config, number = device.replay.log[0]
    assert number == 0
    assert config == {
        "color_resolution": "RES_720P",
        "color_format": "COLOR_BGRA32",
        "depth_mode": "WFOV_UNBINNED",
        "camera_fps": "FPS_15",
        "synchronized_images_only": True,
    }
    with pytest.raises(ValueError, match="at most 15 frames/s for"):
        AzureKinect(depth_mode="WFOV_UNBINNED")
    with pytest.raises(ValueError, match="5, 15 or 30 frames/s, got 7"):
        AzureKinect(fps=7)
    with pytest.raises(CameraNotFoundError, match="is another program using it"):
        some(device.plugged([0], busy=True).camera(), 1)
