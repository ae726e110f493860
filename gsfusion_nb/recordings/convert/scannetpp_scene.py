"""Preparing a ScanNet++ scene: photographs undistorted at half resolution, depth rendered from the scan's mesh.

Files of the licensed copy that are read, ``<scene>/``:

    dslr/nerfstudio/transforms.json           with dslr/resized_images/: a fisheye camera
    dslr/train_test_lists.json
    scans/mesh_aligned_0.05.ply

Depth is that of the mesh at the pinhole's own rays: no depth image is undistorted, so none is interpolated.
"""

import dataclasses
import json
from pathlib import Path

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


class HalfSizePinhole:
    """Converts pictures of a fisheye lens to pinhole pictures at half the resolution.

    The pinhole camera sees nothing that the fisheye camera does not see, and its principal point is the centre of the
    image, as in the ScanNet++ toolbox. A picture is undistorted at full size and then averaged, two by two.
    """

    def __init__(self, lens: CameraModel):
        pinhole = lens.pinhole()
        full = dataclasses.replace(pinhole, cx=pinhole.width / 2, cy=pinhole.height / 2)
        self._map = pixel_map(lens, full)
        self.camera = full.resized(full.width // 2, full.height // 2)

    def __call__(self, picture: np.ndarray) -> np.ndarray:
        """The picture as ``camera`` sees it. [H, W, 3] -> [H/2, W/2, 3], uint8"""
        import cv2

        straight = cv2.remap(picture, *self._map, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return cv2.resize(straight, (self.camera.width, self.camera.height), interpolation=cv2.INTER_AREA)


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
    dslr, names = scene / "dslr", listed_pictures(scene)
    file = dslr / "nerfstudio/transforms.json"
    if not file.is_file() or not (dslr / "resized_images").is_dir():
        raise FetchError(f"{dslr} lacks nerfstudio/transforms.json or resized_images/; expected a scene of ScanNet++")
    values = read_object(file, "nerfstudio transforms")
    if values.get("camera_model") != "OPENCV_FISHEYE":
        raise FetchError(f"{file} describes a {values.get('camera_model')} camera; expected OPENCV_FISHEYE")
    k1, k2, k3, k4 = (number(values, f"k{i}", 0.0, file) for i in range(1, 5))
    try:
        half = HalfSizePinhole(CameraModel(read_camera(values, _KEYS, file, shift=0.0), (k1, k2, k3, k4), fisheye=True))
    except ValueError as e:
        raise FetchError(f"{file}: {e}") from None
    poses = {name: T @ GL_TO_CV for name, T in frame_matrices(values, file).items()}
    turned, c = mesh_in_transforms_world(mesh), half.camera
    with ProgressDisplay("rendering", total=len(names), unit="picture") as display:
        for name in display.over(names):
            if name not in poses:
                raise FetchError(f"{file} has no pose for {name}; expected one for every listed picture")
            write_rgb(folder / "dslr/undistorted_images_2" / name, half(read_rgb(dslr / "resized_images" / name)))
            depth_m = mesh_depth(turned.vertices_W, turned.faces, c, poses[name])
            depth = folder / "dslr/undistorted_depths_2" / f"{Path(name).stem}.png"
            write_depth(depth, depth_m.where(depth_m < _FARTHEST_M, 0.0).numpy(), 1000.0)
    kept = {key: values[key] for key in ("frames", "test_frames") if key in values}
    numbers = {"fl_x": c.fx, "fl_y": c.fy, "cx": c.cx, "cy": c.cy, "w": c.width, "h": c.height}
    transforms = numbers | {"camera_model": "PINHOLE"} | kept
    write_file(folder / "dslr/nerfstudio/transforms_undistorted_2.json", json.dumps(transforms, indent=1))
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
