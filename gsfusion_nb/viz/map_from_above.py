"""A map seen from above, with the camera and its path in it."""

import cv2
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ..drawing.pictures import CARD, Picture
from ..gaussians import GaussianModel
from ..geometry import project, se3
from ..geometry.upright import world_up
from ..mapping import Mapper
from ..types import Camera, GaussianParams, Seeds
from .map_pictures import map_picture

PLACE = "the map from above: path and camera in orange, earlier path in blue"

_ABOVE_CAMERAS_M = 0.3
"""What is higher than this above the cameras is left out, so that no ceiling hides the map."""
_OUTLIERS = 0.01
"""This share of the Gaussians may be outside of the picture on each side."""
_MOST_POINTS = 100_000
_MARGIN = 1.1
_FAR = 4.0
"""Height of the view, in extents of the map: lines from there are nearly parallel."""
_DARK = (20, 20, 24)
_ORANGE = (255, 150, 30)
_BLUE = (70, 150, 255)


def drawable(mapper: Mapper) -> GaussianParams:
    """What of a map is drawn from above: its Gaussians, or, of a system that draws them over a
    TSDF, one ball for each vertex of the TSDF's surface, at most 100,000."""
    if "base" not in mapper.description.panels:
        return mapper.gaussians.params
    mesh = mapper.mesh()
    stride = max(1, len(mesh.vertices_W) // _MOST_POINTS)
    seeds = Seeds.isotropic(
        mesh.vertices_W[::stride],
        mesh.rgb[::stride],
        torch.full_like(mesh.vertices_W[::stride, 0], 0.5 * mapper.config.tsdf.voxel_size_m)
        * stride**0.5,
        opacity=0.95,
    )
    model = GaussianModel(sh_degree=0)
    model.append(seeds, 0)
    return model.params


def map_from_above(
    params: GaussianParams,
    earlier_poses: list[Float[Tensor, "4 4"]],
    poses: list[Float[Tensor, "4 4"]],
    size: tuple[int, int],
) -> Picture:
    """Draw the map below the cameras' height, both paths, and where the camera is now.

    Args:
        params: What is drawn (``drawable``).
        earlier_poses: Camera-to-world, of the recording that the map was made of.
        poses: Of the camera in it; empty if it is not located yet.
        size: Width and height of the picture, pixels.
    """
    all_poses = torch.stack([*earlier_poses, *poses]).double()
    T_WC, up_W = _axes_from_above(list(all_poses))
    params = _below(params, up_W, _height_of(all_poses, up_W))
    camera, T_WC = _view(params.xyz_W, all_poses, T_WC, size)
    background = torch.full((3,), 0.12, device=params.xyz_W.device)
    picture = map_picture(params, camera, T_WC, background=background)
    picture = np.ascontiguousarray(picture)
    _draw_path(picture, _pixels(camera, T_WC, all_poses[: len(earlier_poses), :3, 3]), _BLUE)
    if poses:
        _draw_path(picture, _pixels(camera, T_WC, all_poses[len(earlier_poses) :, :3, 3]), _ORANGE)
        _draw_camera(picture, camera, T_WC, all_poses[-1])
    return picture


def stacked(upper: Picture, lower: Picture) -> Picture:
    """One picture above another one, with the same left edge."""
    width = max(upper.shape[1], lower.shape[1])
    whole = np.full((len(upper) + len(lower), width, 3), CARD, np.uint8)
    whole[: len(upper), : upper.shape[1]] = upper
    whole[len(upper) :, : lower.shape[1]] = lower
    return whole


def _axes_from_above(poses: list[Tensor]) -> tuple[Float[Tensor, "4 4"], Float[Tensor, "3"]]:
    """A camera that looks straight down, with the first view's direction up in the picture; its
    place is still the origin. And the direction that is up in the world."""
    up_W = world_up(poses).double()
    ahead_W = poses[0][:3, 2] - (poses[0][:3, 2] @ up_W) * up_W
    if float(ahead_W.norm()) < 1e-3:  # it looks straight up or down
        ahead_W = torch.eye(3, dtype=torch.float64)[int(up_W.abs().argmin())]
        ahead_W = ahead_W - (ahead_W @ up_W) * up_W
    ahead_W = ahead_W / ahead_W.norm()
    T_WC = torch.eye(4, dtype=torch.float64)
    T_WC[:3, :3] = torch.stack([torch.linalg.cross(ahead_W, up_W), -ahead_W, -up_W], dim=1)
    return T_WC, up_W


def _height_of(poses: Float[Tensor, "N 4 4"], up_W: Float[Tensor, "3"]) -> float:
    return float((poses[:, :3, 3] @ up_W).median())


def _below(params: GaussianParams, up_W: Float[Tensor, "3"], camera_m: float) -> GaussianParams:
    """The Gaussians that are not above the cameras; all, if these are few."""
    rows = params.xyz_W @ up_W.to(params.xyz_W) < camera_m + _ABOVE_CAMERAS_M
    return params[rows] if int(rows.sum()) > len(rows) // 10 else params


def _view(
    xyz_W: Float[Tensor, "N 3"],
    poses: Float[Tensor, "M 4 4"],
    T_WC: Float[Tensor, "4 4"],
    size: tuple[int, int],
) -> tuple[Camera, Float[Tensor, "4 4"]]:
    """Camera and pose from which map and paths fill the picture."""
    width, height = size
    limits = torch.tensor([_OUTLIERS, 1 - _OUTLIERS], dtype=torch.float64)
    sample = xyz_W[:: max(1, len(xyz_W) // _MOST_POINTS)].detach().cpu().double()
    of_map = torch.quantile(se3.apply(se3.inverse(T_WC), sample), limits, dim=0)
    of_path = se3.apply(se3.inverse(T_WC), poses[:, :3, 3])
    low = torch.minimum(of_map[0], of_path.amin(0))
    high = torch.maximum(of_map[1], of_path.amax(0))
    extent_m = _MARGIN * float(torch.maximum(high - low, torch.tensor(0.5).double())[:2].max())
    middle = (low + high) / 2
    middle[2] = low[2] - _FAR * extent_m
    T_WC = T_WC.clone()
    T_WC[:3, 3] = T_WC[:3, :3] @ middle
    across_m = _MARGIN * torch.maximum(high - low, torch.tensor(0.1).double())
    pixels_per_m = min(width / float(across_m[0]), height / float(across_m[1]))
    focal_px = pixels_per_m * _FAR * extent_m
    camera = Camera(
        width=width,
        height=height,
        fx=focal_px,
        fy=focal_px,
        cx=width / 2,
        cy=height / 2,
    )
    return camera, T_WC.float()


def _pixels(
    camera: Camera, T_WC: Float[Tensor, "4 4"], xyz_W: Float[Tensor, "N 3"]
) -> Float[np.ndarray, "N 2"]:
    uv = project(camera, se3.apply(se3.inverse(T_WC.double()), xyz_W.double()))
    return uv.numpy().clip(-1e4, 1e4)


def _draw_path(picture: Picture, uv: Float[np.ndarray, "N 2"], ink: tuple[int, int, int]) -> None:
    points = [np.rint(uv).astype(np.int32)]
    cv2.polylines(picture, points, isClosed=False, color=_DARK, thickness=4, lineType=cv2.LINE_AA)
    cv2.polylines(picture, points, isClosed=False, color=ink, thickness=2, lineType=cv2.LINE_AA)


def _draw_camera(
    picture: Picture,
    camera: Camera,
    T_WC: Float[Tensor, "4 4"],
    T_WC_now: Float[Tensor, "4 4"],
) -> None:
    """A wedge that opens where the camera looks, and a dot where it is."""
    reach_px = max(8.0, min(picture.shape[:2]) / 8)
    ahead = (T_WC[:3, :3].double().T @ T_WC_now[:3, 2])[:2].numpy()
    (at,) = _pixels(camera, T_WC, T_WC_now[None, :3, 3])
    side = np.array([-ahead[1], ahead[0]])
    wedge = np.stack([at, at + reach_px * (ahead + side / 2), at + reach_px * (ahead - side / 2)])
    corners = np.rint(wedge).astype(np.int32)
    cv2.fillPoly(picture, [corners], _ORANGE, cv2.LINE_AA)
    cv2.polylines(picture, [corners], True, _DARK, 1, cv2.LINE_AA)
    centre = tuple(int(v) for v in np.rint(at))
    cv2.circle(picture, centre, 4, _DARK, -1, cv2.LINE_AA)
    cv2.circle(picture, centre, 3, (255, 255, 255), -1, cv2.LINE_AA)
