"""Kinds of pixels, by what is known of a view without the map: edges of the depth, distance, angle,
the border of the picture, and how many mapped views show the same place."""

import math
from collections.abc import Iterator, Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ..geometry import depth_to_normals, pixel_grid, project, rays, se3
from ..geometry.camera import depth_to_points
from ..types import Frame

EDGE_JUMP = 0.05
"""The depth jumps where it changes by this share from a pixel to the next, beside what a plane
does."""
EDGE_PX = 2
"""A pixel is at an edge of the depth if a jump is at most this far, pixels."""
NEAR_M = 1.5
FAR_M = 2.5
"""Limits of the distances, metres."""
LEANING_DEG = 60.0
"""A surface leans away from the camera from this angle between its normal and the ray on."""
FEW_VIEWS = 0.05
"""A place is in few mapped views if at most this share of them shows it."""
SAME_PLACE = 0.03
"""A view shows a place if the depth that it measured there differs by at most this share."""
BORDER = 0.05
"""Width of the border of the picture, as a share of its width."""


def pixel_kinds(frame: Frame, mapped: Sequence[Frame]) -> Iterator[tuple[str, Bool[Tensor, "H W"]]]:
    """Name of each kind of pixel, and which pixels of the frame are of it. Kinds may overlap.

    Args:
        frame: The view; its measured depth decides.
        mapped: Views that the map was made of.
    """
    depth_m = frame.depth_m
    yield "all pixels", torch.ones_like(depth_m, dtype=torch.bool)
    at_edge = is_at_edge(depth_m)
    yield "at an edge of the depth", at_edge
    inside = ~at_edge
    yield "elsewhere", inside
    yield f"nearer than {NEAR_M} m", inside & (depth_m < NEAR_M)
    yield f"{NEAR_M} to {FAR_M} m", inside & (depth_m >= NEAR_M) & (depth_m < FAR_M)
    yield f"farther than {FAR_M} m", inside & (depth_m >= FAR_M)
    yield "leaning", inside & is_leaning(frame)
    yield "in few mapped views", inside & (share_of_views(frame, mapped) <= FEW_VIEWS)
    yield "at the border of the picture", inside & is_at_border(depth_m)


def is_at_edge(depth_m: Float[Tensor, "H W"]) -> Bool[Tensor, "H W"]:
    """Whether a jump of the depth is within ``EDGE_PX`` pixels.

    On a plane 1 / z is linear in the picture, however much the plane leans. So a jump is where the
    second difference of 1 / z along a row or a column is above ``EDGE_JUMP`` times 1 / z, which is
    so on both sides of it.
    """
    inverse = torch.where(depth_m > 0, 1 / depth_m, 0.0)
    jumps = torch.zeros_like(depth_m)
    jumps[:, 1:-1] += _bends(inverse)
    jumps[1:-1] += _bends(inverse.T).T
    around = torch.nn.functional.max_pool2d(jumps[None], 2 * EDGE_PX - 1, 1, EDGE_PX - 1)[0]
    return around > 0


def _bends(inverse: Float[Tensor, "M N"]) -> Bool[Tensor, "M K"]:
    """For the inner elements of each row whether 1 / z jumps there; not where one of the three is
    missing."""
    before = inverse[:, :-2]
    middle = inverse[:, 1:-1]
    after = inverse[:, 2:]
    is_measured = (before > 0) & (middle > 0) & (after > 0)
    return is_measured & ((before - 2 * middle + after).abs() > EDGE_JUMP * middle)


def is_leaning(frame: Frame) -> Bool[Tensor, "H W"]:
    """Whether the ray meets the surface at ``LEANING_DEG`` or more from its normal; False where the
    normal is unknown."""
    normal = depth_to_normals(frame.camera, frame.depth_m)
    ray = torch.nn.functional.normalize(rays(frame.camera, pixel_grid(frame.camera)), dim=-1)
    cosine = (normal * ray).sum(dim=-1).abs()
    return (normal != 0).any(dim=-1) & (cosine <= math.cos(math.radians(LEANING_DEG)))


def is_at_border(image: Float[Tensor, "H W"]) -> Bool[Tensor, "H W"]:
    """Whether a pixel is in the outer ``BORDER`` of the picture."""
    width_px = round(BORDER * image.shape[1])
    at_border = torch.ones_like(image, dtype=torch.bool)
    at_border[width_px : image.shape[0] - width_px, width_px : image.shape[1] - width_px] = False
    return at_border


def share_of_views(frame: Frame, mapped: Sequence[Frame]) -> Float[Tensor, "H W"]:
    """In which share of the mapped views the place of each pixel is seen, 0 to 1."""
    xyz_W = se3.apply(frame.T_WC, depth_to_points(frame.camera, frame.depth_m).flatten(0, 1))
    n_seen = torch.zeros(len(xyz_W))
    for view in mapped:
        xyz_C = se3.apply(se3.inverse(view.T_WC), xyz_W)
        in_front = (xyz_C[:, 2] > 0).nonzero()[:, 0]
        uv = project(view.camera, xyz_C[in_front])
        size = uv.new_tensor([view.camera.width, view.camera.height])
        in_picture = ((uv >= 0) & (uv < size)).all(dim=1)
        column, row = uv[in_picture].long().unbind(dim=1)
        shown = in_front[in_picture]
        z = xyz_C[shown, 2]
        n_seen[shown] += ((view.depth_m[row, column] - z).abs() <= SAME_PLACE * z).float()
    return (n_seen / max(len(mapped), 1)).reshape(frame.depth_m.shape)
