"""A mesh as a picture without VTK or a graphics card: a depth buffer and interpolated colours, in whole-array code."""

from collections.abc import Iterator
from typing import Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import normalize

from ...checks import check_pose
from ...drawing.pictures import Picture
from ...geometry import camera as pinhole
from ...geometry import se3
from ...types import Camera, Mesh

BACKGROUND = (245, 246, 248)
_NEAR_M = 0.05
_AT_ONCE = 1 << 20
"""Pixels of triangles' rectangles that are examined together."""


def draw_mesh(
    mesh: Mesh,
    camera: Camera,
    T_WC: Float[Tensor, "4 4"],
    *,
    shading: Literal["colour", "shape"] = "colour",
) -> Picture:
    """The mesh seen by a camera; triangles seen from behind are left out, so that one can look into a closed room;
    those with a corner within 5 cm of the camera's plane or that is no number are left out, too.

    Args:
        mesh: Any mesh; a million triangles take one to two seconds.
        camera: Intrinsics and size.
        T_WC: Camera-to-world pose.
        shading: "colour": vertex colours under a soft lamp at the camera; "shape": the lamp alone, on grey.
    """
    check_pose("T_WC", T_WC)
    xyz_C = se3.apply(se3.inverse(T_WC.detach().cpu().float()), mesh.vertices_W.detach().cpu().float())
    faces = mesh.faces.cpu()
    corner = xyz_C[faces]
    normal = normalize(torch.linalg.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), dim=1)
    towards = -(normal * normalize(corner.mean(1), dim=1)).sum(1)
    kept = ((corner[..., 2] > _NEAR_M).all(1) & corner.isfinite().all((1, 2)) & (towards > 0)).nonzero()[:, 0]
    uv, inverse_depth = pinhole.project(camera, corner[kept]), 1 / corner[kept][..., 2]
    nearest = _depth_buffer(uv, inverse_depth, camera)
    pixel = (nearest >= 0).nonzero()[:, 0]
    seen = nearest[pixel]
    weight = _weights(uv[seen], _centres(pixel, camera)) * inverse_depth[seen]  # straight in the picture: 1 / depth
    weight = (weight / weight.sum(1, keepdim=True))[..., None]
    rgb = mesh.rgb.cpu()[faces[kept[seen]]] if shading == "colour" else torch.full((len(seen), 3, 3), 0.85)
    light = 0.7 + 0.3 * towards[kept[seen]] if shading == "colour" else 0.2 + 0.8 * towards[kept[seen]]
    picture = torch.tensor(BACKGROUND, dtype=torch.uint8).repeat(camera.height * camera.width, 1)
    picture[pixel] = (((weight * rgb).sum(1) * light[:, None]).clamp(0, 1) * 255 + 0.5).to(torch.uint8)
    return picture.view(camera.height, camera.width, 3).numpy()


def _depth_buffer(
    uv: Float[Tensor, "F 3 2"], inverse_depth: Float[Tensor, "F 3"], camera: Camera
) -> Int[Tensor, " HW"]:
    """The row of the nearest triangle at each pixel's centre, or -1."""
    nearest = torch.full((camera.height * camera.width,), -1)
    for triangle, pixel in _candidates(uv, camera):
        weight = _weights(uv[triangle], _centres(pixel, camera))
        inside = (weight >= 0).all(1)
        triangle, pixel = triangle[inside], pixel[inside]
        depth = (weight[inside] * inverse_depth[triangle]).sum(1)
        key = depth.contiguous().view(torch.int32).long() << 32 | triangle  # positive floats sort like their bits
        nearest.scatter_reduce_(0, pixel, key, "amax")
    return torch.where(nearest >= 0, nearest & 0xFFFFFFFF, nearest)


def _candidates(uv: Float[Tensor, "F 3 2"], camera: Camera) -> Iterator[tuple[Int[Tensor, " N"], Int[Tensor, " N"]]]:
    """Triangles with each pixel whose centre lies in the rectangle around them, a limited number at a time."""
    last = torch.tensor([camera.width - 1, camera.height - 1])
    low = (uv.amin(1) - 0.5).ceil().clamp(min=0).minimum(last + 1.0).long()
    high = (uv.amax(1) - 0.5).floor().clamp(min=-1).minimum(last.float()).long()
    span = (high - low + 1).clamp_min(0)
    count = span.prod(1)
    batch = count.cumsum(0) // _AT_ONCE
    for rows in (count > 0).nonzero()[:, 0].split_with_sizes(torch.bincount(batch[count > 0]).tolist()):
        triangle = rows.repeat_interleave(count[rows])
        place = torch.arange(len(triangle)) - (count[rows].cumsum(0) - count[rows]).repeat_interleave(count[rows])
        column, row = low[triangle, 0] + place % span[triangle, 0], low[triangle, 1] + place // span[triangle, 0]
        yield triangle, row * camera.width + column


def _centres(pixel: Int[Tensor, " N"], camera: Camera) -> Float[Tensor, "N 2"]:
    return torch.stack([pixel % camera.width, pixel // camera.width], 1) + 0.5


def _weights(uv: Float[Tensor, "N 3 2"], point: Float[Tensor, "N 2"]) -> Float[Tensor, "N 3"]:
    """Barycentric coordinates of points in the picture, shape (N, 3); all are >= 0 inside; NaN without an area."""
    a, b, c = ((corner - point) for corner in uv.unbind(1))
    area = torch.stack([_cross(b, c), _cross(c, a), _cross(a, b)], 1)
    return area / area.sum(1, keepdim=True)


def _cross(a: Float[Tensor, "N 2"], b: Float[Tensor, "N 2"]) -> Float[Tensor, " N"]:
    return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
