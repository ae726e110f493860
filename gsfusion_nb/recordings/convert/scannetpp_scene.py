"""Preparing a ScanNet++ scene: photographs undistorted at half resolution, depth rendered from the scan's mesh.

Files of the licensed copy that are read, ``<scene>/``:

    dslr/nerfstudio/transforms.json           with dslr/resized_images/: a fisheye camera; or
    dslr/nerfstudio/transforms_undistorted.json   with dslr/resized_undistorted_images/ (or undistorted_images/)
    dslr/train_test_lists.json
    scans/mesh_aligned_0.05.ply

Depth is that of the mesh at the pinhole's own rays: no depth image is undistorted, so none is interpolated.
"""

import dataclasses
import json
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ...data.lens.camera_model import CameraModel, pixel_map
from ...data.readers.scannetpp import frame_matrices
from ...data.recorded.camera_json import camera as read_camera
from ...data.recorded.camera_json import number
from ...data.recorded.images import read_rgb
from ...files import write_file
from ...foreign import read_bytes, read_object
from ...types import Camera, Mesh
from ..fetch import FetchError
from .mesh_depth import mesh_depth

MESH = "scans/mesh_aligned_0.05.ply"
_KEYS = ("w", "h", "fl_x", "fl_y", "cx", "cy")
_GL_TO_CV = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64))
_MAX_DEPTH_MM = 65535


@dataclass(frozen=True)
class Photographs:
    """Where the pictures are, and how they are converted to those of a pinhole camera."""

    folder: Path
    file: Path
    """The transforms file."""
    values: dict[str, Any]
    """Its content."""
    camera: Camera
    """The pinhole camera at half size."""
    turn: Callable[[np.ndarray], np.ndarray]

    @staticmethod
    def find(scene: Path) -> "Photographs":
        """Photographs of a copy of a scene. Raises ``FetchError`` if it has neither kind."""
        dslr = scene / "dslr"
        fisheye, pinhole = (dslr / f"nerfstudio/transforms{end}.json" for end in ("", "_undistorted"))
        if fisheye.is_file() and (dslr / "resized_images").is_dir():
            values = read_object(fisheye, "nerfstudio transforms")
            if values.get("camera_model") != "OPENCV_FISHEYE":
                raise FetchError(f"{fisheye} describes a {values.get('camera_model')} camera; expected OPENCV_FISHEYE")
            k1, k2, k3, k4 = (number(values, f"k{i}", 0.0, fisheye) for i in range(1, 5))
            lens = CameraModel(read_camera(values, _KEYS, fisheye, shift=0.0), (k1, k2, k3, k4), fisheye=True)
            try:
                half = HalfSizePinhole(lens)
            except ValueError as e:
                raise FetchError(f"{fisheye}: {e}") from None
            return Photographs(dslr / "resized_images", fisheye, values, half.camera, half)
        for name in ("resized_undistorted_images", "undistorted_images"):
            if pinhole.is_file() and (dslr / name).is_dir():
                values = read_object(pinhole, "nerfstudio transforms")
                camera = half_size(read_camera(values, _KEYS, pinhole, shift=0.0))
                return Photographs(dslr / name, pinhole, values, camera, partial(shrink, camera=camera))
        raise FetchError(
            f"{dslr} holds neither nerfstudio/transforms.json with resized_images/ nor "
            "nerfstudio/transforms_undistorted.json with resized_undistorted_images/; expected a scene of ScanNet++"
        )

    def poses(self) -> dict[str, Float[Tensor, "4 4"]]:
        """Camera-to-world, OpenCV axes, in the world frame of the file, by picture name."""
        return {name: T @ _GL_TO_CV for name, T in frame_matrices(self.values, self.file).items()}

    def transforms(self) -> dict[str, Any]:
        """Content of ``transforms_undistorted_2.json``: the unchanged frames and the pinhole's intrinsics."""
        c = self.camera
        kept = {key: self.values[key] for key in ("frames", "test_frames") if key in self.values}
        numbers = {"fl_x": c.fx, "fl_y": c.fy, "cx": c.cx, "cy": c.cy, "w": c.width, "h": c.height}
        return numbers | {"camera_model": "PINHOLE"} | kept


class HalfSizePinhole:
    """Converts pictures of a fisheye lens to pinhole pictures at half the resolution.

    The pinhole camera sees nothing that the fisheye camera does not see, and its principal point is the centre of the
    image, as in the ScanNet++ toolbox. A picture is undistorted at full size and then averaged, two by two.
    """

    def __init__(self, lens: CameraModel):
        pinhole = lens.pinhole()
        full = dataclasses.replace(pinhole, cx=pinhole.width / 2, cy=pinhole.height / 2)
        self._map = pixel_map(lens, full)
        self.camera = half_size(full)

    def __call__(self, picture: np.ndarray) -> np.ndarray:
        """The picture as ``camera`` sees it. [H, W, 3] -> [H/2, W/2, 3], uint8"""
        import cv2

        return shrink(cv2.remap(picture, *self._map, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), self.camera)


def half_size(camera: Camera) -> Camera:
    """The same view with half the pixels in each direction."""
    return camera.resized(camera.width // 2, camera.height // 2)


def shrink(picture: np.ndarray, camera: Camera) -> np.ndarray:
    """A picture averaged down to the size of ``camera``."""
    import cv2

    return cv2.resize(picture, (camera.width, camera.height), interpolation=cv2.INTER_AREA)


def listed_pictures(scene: Path) -> list[str]:
    """Pictures of ``train_test_lists.json``, training ones first."""
    path = scene / "dslr/train_test_lists.json"
    lists = read_object(path, "the lists train and test")
    names = [name for key in ("train", "test") for name in lists.get(key) or []]
    if not names or not all(isinstance(name, str) for name in names):
        raise FetchError(f"{path} lists no pictures; expected the lists train and test")
    return names


def mesh_in_transforms_world(mesh: Mesh) -> Mesh:
    """The scan's mesh in the world frame of the transforms files: x and y swapped, z negated (a rotation)."""
    x, y, z = mesh.vertices_W.unbind(dim=1)
    return Mesh(vertices_W=torch.stack([y, x, -z], dim=1), faces=mesh.faces, rgb=mesh.rgb)


def prepare_scene(
    scene: Path, mesh: Mesh, folder: Path, *, progress: Callable[[int, int], object] = lambda done, count: None
) -> int:
    """Write a scene for the ``scannetpp`` reader; pictures that are already in ``folder`` are kept.

    Args:
        scene: The licensed copy of one scene (module docstring).
        mesh: Its scan, as stored.
        folder: Folder to write.
        progress: Called after every picture with the number done and the total.

    Returns:
        Number of pictures.

    Raises:
        FetchError: a part of the scene is missing. SequenceError: a file of it is damaged.
    """
    pictures, names = Photographs.find(scene), listed_pictures(scene)
    poses = pictures.poses()
    turned = mesh_in_transforms_world(mesh)
    for i, name in enumerate(names):
        if name not in poses:
            raise FetchError(
                f"{scene}: the transforms file has no pose for {name}; expected one for every listed picture"
            )
        picture = folder / "dslr/undistorted_images_2" / name
        depth = folder / "dslr/undistorted_depths_2" / f"{Path(name).stem}.png"
        if not depth.exists():
            _write_picture(picture, pictures.turn(read_rgb(pictures.folder / name)))
            _write_depth(depth, mesh_depth(turned.vertices_W, turned.faces, pictures.camera, poses[name]))
        progress(i + 1, len(names))
    write_file(folder / "dslr/nerfstudio/transforms_undistorted_2.json", json.dumps(pictures.transforms(), indent=1))
    write_file(folder / "dslr/train_test_lists.json", read_bytes(scene / "dslr/train_test_lists.json", "the lists"))
    return len(names)


def _write_picture(path: Path, rgb: np.ndarray) -> None:
    import cv2

    quality = [cv2.IMWRITE_JPEG_QUALITY, 97, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444]
    write_file(path, cv2.imencode(".jpg", rgb[..., ::-1], quality)[1].tobytes())


def _write_depth(path: Path, depth_m: Float[Tensor, "H W"]) -> None:
    import cv2

    stored = np.rint(depth_m.double().numpy() * 1000)
    stored[stored > _MAX_DEPTH_MM] = 0
    write_file(path, cv2.imencode(".png", stored.astype(np.uint16))[1].tobytes())
