"""Converting the images of a recording to what the one camera of a sequence sees."""

from functools import lru_cache

import cv2
import numpy as np
import torch

from ...data.adjust.resize import resize_colour
from ...data.depth_registration import TIE, register_depth
from ...data.lens import CameraModel, pixel_map, same_proportions, same_rays, z_of_range
from ...types import Camera
from .recording import OptionNeeded, RecordedFrame, RgbdImages

_map = lru_cache(maxsize=4)(pixel_map)
"""A recording with another focal length in every frame makes as many maps as frames; few are
kept."""


def _depth_model(frame: RecordedFrame, colour: CameraModel, width: int, height: int) -> CameraModel:
    """Camera of the depth image, at its size.

    Raises:
        OptionNeeded: depth is to be registered to colour, but has other proportions, so it shows
            another view.
        SequenceError: depth has other proportions than its own camera.
    """
    if frame.depth_model is not None:
        return frame.depth_model.fitted(width, height, f"the depth of {frame.source}")
    size = (colour.camera.width, colour.camera.height)
    if same_proportions((width, height), size):
        return colour.resized(width, height)
    raise OptionNeeded(
        f"{frame.source}: depth is {width}x{height} and colour {size[0]}x{size[1]}, of other "
        "proportions, so they are not of one view; give the intrinsics of the depth images with "
        "--depth-intrinsics 'fx fy cx cy', and with --T-colour-depth where their camera stands",
        option="depth_intrinsics",
        question=f"Depth ({width}x{height}) is not registered to colour ({size[0]}x{size[1]}). "
        "What are the intrinsics of the depth images, fx fy cx cy, or which file holds them?",
    )


class Rectifier:
    """Converts colour and depth to what ``camera`` would see.

    Colour is undistorted at its own size (interpolated), then averaged down. Depth is taken from
    the nearest pixel and never interpolated; if the depth camera is at another place, every pixel
    of depth is moved to the pixels that it covers (``register_depth``).
    """

    def __init__(self, camera: Camera, *, along_ray: bool = False):
        self.camera = camera
        self._along_ray = along_ray

    def __call__(self, frame: RecordedFrame, model: CameraModel, images: RgbdImages) -> RgbdImages:
        """The images of ``frame``, taken by ``model``. ``encoded`` is empty unless colour is
        unchanged."""
        height, width = images.rgb.shape[:2]
        model = model.fitted(width, height, frame.source)
        rgb = self._colour(images.rgb, model)
        depth_m = self._depth(images.depth_m, model, frame)
        return RgbdImages(rgb, depth_m, images.encoded if rgb is images.rgb else b"")

    def _colour(self, rgb: np.ndarray, model: CameraModel) -> np.ndarray:
        native = self.camera.resized(model.camera.width, model.camera.height)
        if not same_rays(model, native):
            rgb = cv2.remap(
                rgb, *_map(model, native), cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
            )
        return resize_colour(rgb, self.camera.width, self.camera.height)

    def _depth(self, depth_m: np.ndarray, colour: CameraModel, frame: RecordedFrame) -> np.ndarray:
        height, width = depth_m.shape
        model = _depth_model(frame, colour, width, height)
        if self._along_ray:
            depth_m = z_of_range(depth_m, model)
        if frame.T_colour_depth is None:
            return self._nearest(depth_m, model, self.camera)
        pinhole = model.pinhole()
        flat = torch.from_numpy(self._nearest(depth_m, model, pinhole))
        return register_depth(flat, pinhole, self.camera, frame.T_colour_depth).numpy()

    def _nearest(self, depth_m: np.ndarray, model: CameraModel, camera: Camera) -> np.ndarray:
        if same_rays(model, camera):
            return depth_m
        u, v = _map(model, camera)
        return cv2.remap(
            depth_m,
            u - np.float32(TIE),
            v - np.float32(TIE),
            cv2.INTER_NEAREST,
            borderValue=0,
        )
