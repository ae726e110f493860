"""Converting the images of every frame to the one camera of a sequence."""

from collections import OrderedDict

import numpy as np
import torch

from ...data.adjust.resize import resize_colour
from ...data.lens.camera_model import TIE, CameraModel, pixel_map, same_rays, z_of_range
from ...data.lens.register import warp_depth
from ...types import Camera
from .recording import RecordedFrame, RgbdImages

_KEPT_MAPS = 4
"""Pixel maps kept; a recording with another focal length in every frame makes as many maps as frames."""


class Rectifier:
    """Converts colour and depth to what ``camera`` would see.

    Colour is undistorted at its own size (interpolated), then averaged down. Depth is taken from the nearest pixel and
    never interpolated; if the depth camera is at another place, every point is moved to its pixel (``warp_depth``).
    """

    def __init__(self, camera: Camera, *, along_ray: bool = False):
        self.camera = camera
        self._along_ray = along_ray
        self._maps: OrderedDict[tuple[CameraModel, Camera], tuple[np.ndarray, np.ndarray]] = OrderedDict()

    def __call__(self, frame: RecordedFrame, model: CameraModel, images: RgbdImages) -> RgbdImages:
        """The images of ``frame``, taken by ``model``. ``encoded`` is empty unless colour is unchanged."""
        height, width = images.rgb.shape[:2]
        model = model.fitted(width, height, frame.source)
        rgb = self._colour(images.rgb, model)
        depth_m = self._depth(images.depth_m, model, frame)
        return RgbdImages(rgb, depth_m, images.encoded if rgb is images.rgb else b"")

    def _colour(self, rgb: np.ndarray, model: CameraModel) -> np.ndarray:
        import cv2

        native = self.camera.resized(model.camera.width, model.camera.height)
        if not same_rays(model, native):
            rgb = cv2.remap(rgb, *self._map(model, native), cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return resize_colour(rgb, self.camera.width, self.camera.height)

    def _depth(self, depth_m: np.ndarray, colour: CameraModel, frame: RecordedFrame) -> np.ndarray:
        height, width = depth_m.shape
        if frame.depth_model is None:
            model = colour.resized(width, height)
        else:
            model = frame.depth_model.fitted(width, height, f"the depth of {frame.source}")
        if self._along_ray:
            depth_m = z_of_range(depth_m, model)
        if frame.T_colour_depth is None:
            return self._nearest(depth_m, model, self.camera)
        pinhole = model.pinhole()
        flat = torch.from_numpy(self._nearest(depth_m, model, pinhole))
        return warp_depth(flat, pinhole, self.camera, frame.T_colour_depth).numpy()

    def _nearest(self, depth_m: np.ndarray, model: CameraModel, camera: Camera) -> np.ndarray:
        import cv2

        if same_rays(model, camera):
            return depth_m
        u, v = self._map(model, camera)
        return cv2.remap(depth_m, u - np.float32(TIE), v - np.float32(TIE), cv2.INTER_NEAREST, borderValue=0)

    def _map(self, model: CameraModel, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
        key = (model, camera)
        if key not in self._maps:
            self._maps[key] = pixel_map(model, camera)
        self._maps.move_to_end(key)
        while len(self._maps) > _KEPT_MAPS:
            self._maps.popitem(last=False)
        return self._maps[key]


def output_camera(model: CameraModel, width: int, height: int) -> Camera:
    """The pinhole that is written: of ``model`` undistorted, at the wanted size; one side keeps the proportions."""
    camera = model.pinhole()
    if not width and not height:
        return camera
    width = width or max(1, round(camera.width * height / camera.height))
    height = height or max(1, round(camera.height * width / camera.width))
    return camera.resized(width, height)
