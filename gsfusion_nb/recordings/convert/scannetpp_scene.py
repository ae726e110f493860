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
from jaxtyping import Float, Int
from torch import Tensor

from ...data.lens import CameraModel, pixel_map
from ...data.readers.scannetpp import frame_matrices
from ...data.recorded.files import camera as read_camera
from ...data.recorded.files import number
from ...data.recorded.images import read_rgb
from ...data.recorded.poses import GL_TO_CV
from ...data.room.hand_held import write_depth, write_rgb
from ...files import read_bytes, read_object, write_file
from ...geometry import se3
from ...types import Camera, Mesh
from ...work import ProgressDisplay
from ..fetch import FetchError

MESH = "scans/mesh_aligned_0.05.ply"
_KEYS = ("w", "h", "fl_x", "fl_y", "cx", "cy")
_FARTHEST_M = 65.535
"""Of 16-bit millimetres."""


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
        return {name: T @ GL_TO_CV for name, T in frame_matrices(self.values, self.file).items()}

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


def prepare_scene(scene: Path, mesh: Mesh, folder: Path) -> None:
    """Write a scene for the ``scannetpp`` reader.

    Args:
        scene: The licensed copy of one scene (module docstring).
        mesh: Its scan, as stored.
        folder: Folder to write.

    Raises:
        FetchError: a part of the scene is missing. SequenceError: a file of it is damaged.
    """
    pictures, names = Photographs.find(scene), listed_pictures(scene)
    poses = pictures.poses()
    turned = mesh_in_transforms_world(mesh)
    with ProgressDisplay("rendering", total=len(names), unit="picture") as display:
        for name in display.over(names):
            if name not in poses:
                raise FetchError(
                    f"{scene}: the transforms file has no pose for {name}; expected one for every listed picture"
                )
            picture = folder / "dslr/undistorted_images_2" / name
            depth = folder / "dslr/undistorted_depths_2" / f"{Path(name).stem}.png"
            write_rgb(picture, pictures.turn(read_rgb(pictures.folder / name)))
            depth_m = mesh_depth(turned.vertices_W, turned.faces, pictures.camera, poses[name])
            write_depth(depth, depth_m.where(depth_m < _FARTHEST_M, 0.0).numpy(), 1000.0)
    write_file(folder / "dslr/nerfstudio/transforms_undistorted_2.json", json.dumps(pictures.transforms(), indent=1))
    write_file(folder / "dslr/train_test_lists.json", read_bytes(scene / "dslr/train_test_lists.json", "the lists"))


NEAR_M = 0.02
_SAMPLES = 1 << 21
"""Pixels of triangles processed at once; limits the memory."""


def mesh_depth(
    vertices_W: Float[Tensor, "V 3"], faces: Int[Tensor, "F 3"], camera: Camera, T_WC: Float[Tensor, "4 4"]
) -> Float[Tensor, "H W"]:
    """z-depth of the first triangle that the ray through each pixel's centre meets, from either side.

    With a triangle's corners P0, P1, P2 in the camera frame, the ray t r, r = (x, y, 1), meets it where the three edge
    functions e_i = (P_j x P_k) . r have the sign of det = P0 . n, n = (P1 - P0) x (P2 - P0); there
    1/t = (n . r) / det. Nothing is projected, so a triangle may reach behind the camera; two triangles that share an
    edge leave no gap, since their edge functions are exact negatives.

    Args:
        vertices_W: World frame, metres. [V, 3]
        faces: Vertex numbers. [F, 3]
        camera: Intrinsics.
        T_WC: Camera-to-world pose. [4, 4]

    Returns:
        z-depth, metres, 0 where the ray does not meet the mesh, or nearer than 2 cm. [H, W] float32

    Differentiable: no. Source: Olano & Greer 1997, "Triangle scan conversion using 2D homogeneous coordinates".
    """
    P = se3.apply(se3.inverse(T_WC.double()), vertices_W.double())[faces.long()]
    P = P[(P[..., 2] > NEAR_M).any(dim=1)]
    low, high = _pixel_bounds(P, camera)
    size = high - low + 1
    seen = (size > 0).all(dim=1)
    P, low, high, size = P[seen], low[seen], high[seen], size[seen]
    edges = torch.stack([_cross(P[:, i - 2], P[:, i - 1]) for i in range(3)], dim=1)
    n = _cross(P[:, 1] - P[:, 0], P[:, 2] - P[:, 0])
    det = (P[:, 0] * n).sum(-1)
    plane = n / det.where(det != 0, torch.ones_like(det))[:, None]
    edges = (edges * det.sign()[:, None, None]).float()
    plane = torch.where(det[:, None] != 0, plane, torch.zeros_like(plane)).float()
    nearest = torch.zeros(camera.height * camera.width, device=P.device)  # inverse depth
    power = torch.ceil(torch.log2(size.double())).long()
    for key in torch.unique(power, dim=0).tolist():
        nx, ny = 2 ** key[0], 2 ** key[1]
        rows = torch.nonzero((power == torch.tensor(key, device=P.device)).all(dim=1)).squeeze(1)
        for part in rows.split(max(1, _SAMPLES // (nx * ny))):
            _draw(nearest, camera, edges[part], plane[part], low[part], high[part], (nx, ny))
    return torch.where(nearest > 0, 1.0 / nearest.clamp(min=1e-12), 0.0).reshape(camera.height, camera.width)


def _cross(a: Float[Tensor, "F 3"], b: Float[Tensor, "F 3"]) -> Float[Tensor, "F 3"]:
    # In one fixed order, so that b x a is exactly -(a x b) which the library's function does not guarantee.
    i, j = [1, 2, 0], [2, 0, 1]
    return a[:, i] * b[:, j] - a[:, j] * b[:, i]


def _pixel_bounds(P: Float[Tensor, "F 3 3"], camera: Camera) -> tuple[Int[Tensor, "F 2"], Int[Tensor, "F 2"]]:
    """First and last pixel (column, row) whose centre may lie in each triangle; cut at the near plane and the image."""
    front = P[..., 2] >= NEAR_M
    after = P[:, [1, 2, 0]]
    gap = after[..., 2] - P[..., 2]
    crosses = front != front[:, [1, 2, 0]]
    s = torch.where(crosses, (NEAR_M - P[..., 2]) / gap.where(crosses, torch.ones_like(gap)), 0.0)
    points = torch.cat([P, P + s[..., None] * (after - P)], dim=1)
    counts = torch.cat([front, crosses], dim=1)[..., None]
    z = points[..., 2:].clamp(min=0.5 * NEAR_M)
    focal = points.new_tensor([camera.fx, camera.fy])
    uv = points[..., :2] / z * focal + points.new_tensor([camera.cx, camera.cy])
    limit = points.new_tensor([camera.width, camera.height])
    low = uv.where(counts, torch.inf).amin(dim=1)
    high = uv.where(counts, -torch.inf).amax(dim=1)
    # A thousandth of a pixel too wide, because the edge functions decide exactly.
    first = torch.ceil((low - 0.501).clamp(min=0)).minimum(limit)
    last = torch.floor((high - 0.499).clamp(min=-1)).minimum(limit - 1)
    return first.long(), last.long()


def _draw(
    nearest: Float[Tensor, " P"],
    camera: Camera,
    edges: Float[Tensor, "F 3 3"],
    plane: Float[Tensor, "F 3"],
    low: Int[Tensor, "F 2"],
    high: Int[Tensor, "F 2"],
    size: tuple[int, int],
) -> None:
    """Raise the inverse depths in ``nearest`` to those of some triangles, each within ``size`` pixels from ``low``."""
    column = low[:, 0, None] + torch.arange(size[0], device=low.device)
    row = low[:, 1, None] + torch.arange(size[1], device=low.device)
    x = (column + 0.5 - camera.cx) / camera.fx
    y = (row + 0.5 - camera.cy) / camera.fy
    inside = (column <= high[:, :1])[:, None, :] & (row <= high[:, 1:])[:, :, None]
    for k in range(3):
        inside &= _linear(edges[:, k], x, y) >= 0
    w = _linear(plane, x, y)
    inside &= (w > 0) & (w < 1.0 / NEAR_M)
    pixel = row[:, :, None] * camera.width + column[:, None, :]
    nearest.scatter_reduce_(0, pixel[inside], w[inside], reduce="amax")


def _linear(a: Float[Tensor, "F 3"], x: Float[Tensor, "F w"], y: Float[Tensor, "F h"]) -> Float[Tensor, "F h w"]:
    return (a[:, :1] * x)[:, None, :] + (a[:, 1:2] * y + a[:, 2:])[:, :, None]
