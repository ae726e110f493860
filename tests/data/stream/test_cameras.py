import importlib.util
import sys
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
import torch

from gsfusion_nb.data.stream import BackgroundFrames, CameraNotFoundError, RealSense
from gsfusion_nb.types import Frame

_spec = importlib.util.spec_from_file_location(
    "fake_drivers", Path(__file__).with_name("fake_drivers.py")
)
assert _spec is not None
assert _spec.loader is not None
fake_drivers = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(fake_drivers)


class Device:
    """A fake camera that shows the box room."""

    def __init__(self, box, monkeypatch):
        self.box = box
        self.monkeypatch = monkeypatch
        self.pictures = [box.render(T) for T in box.poses(4)]

    def plugged(self, plan, coeffs=(0.0,) * 5):
        """Plug it in; ``plan`` is what its driver gives."""
        c = self.box.camera
        self.replay = fake_drivers.Replay(
            self.pictures,
            plan,
            K=(c.fx, c.fy, c.cx - 0.5, c.cy - 0.5),
            size=(c.width, c.height),
            coeffs=coeffs,
        )
        self.monkeypatch.setitem(sys.modules, "pyrealsense2", fake_drivers.realsense(self.replay))
        return self

    def camera(self, **options):
        options = {"warm_up": 0, "timeout_s": 0.5, **options}
        return RealSense(
            width=self.box.camera.width,
            height=self.box.camera.height,
            **options,
        )


@pytest.fixture
def device(box, monkeypatch):
    return Device(box, monkeypatch)


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
        torch.testing.assert_close(
            frame.rgb,
            torch.from_numpy(device.pictures[i][0] / 255).float(),
        )
        assert (
            float((frame.depth_m - torch.from_numpy(device.pictures[i][1])).abs().max()) < 0.00051
        )
        torch.testing.assert_close(frame.T_WC, torch.eye(4))
    steps = np.diff([f.timestamp_s for f in frames])
    np.testing.assert_allclose(steps, 1 / 30, atol=1e-5)
    assert not camera.has_poses
    assert camera.policy == "latest"


def test_pixel_centres_are_ours(device, box):
    """The fake's intrinsics count centres from 0; points lie on the walls only if half a pixel is
    added."""
    import dataclasses

    camera = device.plugged([0]).camera()
    [frame] = some(camera, 1)
    # 32-bit floats of the camera's principal point
    assert frame.camera.cx == pytest.approx(box.camera.cx)
    assert frame.camera.cy == pytest.approx(box.camera.cy)
    there = dataclasses.replace(frame, T_WC=box.poses(1)[0].float())
    assert box.off_wall_m(there) < 0.001


def test_incomplete_frames_and_single_timeouts_are_passed_over(device):
    plan = [0, "timeout", "no depth", 1, "timeout", "timeout", "no colour", 2, "unplug"]
    camera = device.plugged(plan).camera()
    frames = list(camera)
    assert [f.index for f in frames] == [0, 1, 2]


def test_unplugged_in_the_middle_it_ends_and_says_why(device):
    camera = device.plugged([0, 1, "unplug"]).camera()
    with closing(BackgroundFrames(camera)) as frames:
        assert [f.index for f in frames] == [0, 1]
    assert "was disconnected" in camera.broke_off
    assert device.replay.log.count("stopped") == 1


def test_a_silent_camera_is_given_up(device):
    camera = device.plugged([0, "timeout"]).camera()
    assert len(list(camera)) == 1
    assert camera.broke_off == "realsense gave no frame for 2.5 s"


def test_lens_distortion_is_removed_from_both_images(device, box):
    """Pictures of a distorting lens, made by warping the pinhole's; undistorted they show the walls
    where they are."""
    import cv2

    c = box.camera
    k = np.array([0.4, -0.1, 0.01, -0.01, 0.05])
    K = np.array([[c.fx, 0, c.cx - 0.5], [0, c.fy, c.cy - 0.5], [0, 0, 1]])
    uv = (
        np.stack(
            np.meshgrid(np.arange(c.width), np.arange(c.height)),
            -1,
        )
        .reshape(-1, 1, 2)
        .astype(np.float64)
    )
    ideal = cv2.undistortPoints(uv, K, k, P=K).reshape(c.height, c.width, 2).astype(np.float32)
    T = box.poses(1)[0]
    rgb, depth_m = box.render(T)
    device.pictures = [
        tuple(cv2.remap(x, ideal[..., 0], ideal[..., 1], cv2.INTER_LINEAR) for x in (rgb, depth_m))
    ]
    # with the driver's word that there is no distortion
    [stored] = some(device.plugged([0]).camera(), 1)
    [frame] = some(device.plugged([0], tuple(k)).camera(), 1)

    def off(frame: Frame) -> tuple[float, float]:
        """Mean difference from what a pinhole with the frame's intrinsics sees: colour 0..1, depth
        in metres."""
        rgb, depth_m = box.render(T, frame.camera)
        colour = (frame.rgb - torch.from_numpy(rgb / 255)).abs().mean()
        return float(colour), float((frame.depth_m - torch.from_numpy(depth_m)).abs().mean())

    colour, depth_m = off(frame)
    colour_before, depth_before_m = off(stored)
    assert 10 * colour < colour_before
    # taken from the nearest pixel, which is up to half a pixel off
    assert 3 * depth_m < depth_before_m


def test_the_streams_are_those_that_were_asked_for(device):
    some(device.plugged([0]).camera(fps=15, serial="123"), 1)
    streams = [("color", 64, 48, "rgb8", 15), ("depth", 64, 48, "z16", 15)]
    assert device.replay.log == [("device", "123"), *streams, "stopped"]
    with pytest.raises(CameraNotFoundError, match="no RealSense camera 9 streams 64x48 at 30 fps"):
        some(device.plugged([0]).camera(serial="9"), 1)
