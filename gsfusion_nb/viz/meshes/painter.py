"""A mesh as a picture without VTK or a graphics card: flat triangles painted from back to front with OpenCV."""

from typing import Literal

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from ...checks import check_pose
from ...drawing.pictures import Picture
from ...geometry import camera as pinhole
from ...geometry import se3
from ...types import Camera, Mesh

BACKGROUND = (245, 246, 248)
_NEAR_M = 0.05
_SUBPIXEL_BITS = 4


def draw_mesh(
    mesh: Mesh,
    camera: Camera,
    T_WC: Float[Tensor, "4 4"],
    *,
    shading: Literal["colour", "shape"] = "colour",
) -> Picture:
    """The mesh seen by a camera; triangles seen from behind are left out, so that one can look into a closed room.

    Args:
        mesh: Any mesh; 100,000 triangles take about a second.
        camera: Intrinsics and size.
        T_WC: Camera-to-world pose.
        shading: "colour": vertex colours under a soft lamp at the camera; "shape": the lamp alone, on grey.
    """
    import cv2

    check_pose("T_WC", T_WC)
    picture = np.full((camera.height, camera.width, 3), BACKGROUND, np.uint8)
    if not len(mesh.faces):
        return picture
    xyz_C = se3.apply(se3.inverse(T_WC.detach().cpu().float()), mesh.vertices_W.detach().cpu().float())
    faces = mesh.faces.cpu()
    corner = xyz_C[faces]
    normal = normalize(torch.linalg.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), dim=1)
    middle = corner.mean(1)
    towards = -(normal * normalize(middle, dim=1)).sum(1)
    kept = ((corner[..., 2] > _NEAR_M).all(1) & (towards > 0)).nonzero()[:, 0]
    kept = kept[middle[kept, 2].argsort(descending=True)]
    base = mesh.rgb.cpu()[faces[kept]].mean(1) if shading == "colour" else torch.full((len(kept), 3), 0.85)
    light = 0.7 + 0.3 * towards[kept] if shading == "colour" else 0.2 + 0.8 * towards[kept]
    colours = ((base * light[:, None]).clamp(0, 1) * 255 + 0.5).int().tolist()
    uv = pinhole.project(camera, corner[kept]) - 0.5  # OpenCV puts pixel centres at whole numbers
    points = (uv * (1 << _SUBPIXEL_BITS)).clamp(-1e6, 1e6).round().int().numpy()
    for triangle, colour in zip(points, colours, strict=True):
        cv2.fillConvexPoly(picture, triangle, colour, shift=_SUBPIXEL_BITS)
    return picture
