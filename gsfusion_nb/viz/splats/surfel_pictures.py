"""Pictures of RTG-SLAM maps only: the state of the disc that each pixel hits, and why discs were added."""

import numpy as np
import torch
from jaxtyping import Bool
from torch import Tensor

from ...drawing.pictures import AnyImage, Picture, to_uint8
from ...gaussians import GaussianModel, SurfelModel
from ...geometry import project, se3
from ...render import SurfaceView
from ...types import Camera, Frame, RenderOutput

STATE_COLOURS = {
    "stable_opaque": (66, 133, 198),
    "unstable_opaque": (240, 150, 50),
    "stable_transparent": (40, 200, 190),
    "unstable_transparent": (230, 60, 160),
}
"""Names as in ``state_counts``. Opaque: blue and orange; transparent, as dots: turquoise and pink."""
CAUSES = {1: ("new area", (60, 210, 90)), 2: ("depth wrong", (255, 60, 60)), 3: ("colour wrong", (70, 150, 255))}
"""Tag of a Gaussian from the rule ``rtg_slam`` -> why it was added, its colour."""

_NOTHING = (24, 24, 28)


def state_picture(model: SurfelModel, view: SurfaceView | RenderOutput, camera: Camera, T_WC: Tensor) -> Picture:
    """Every pixel in the colour of the state of the disc that it hits, shaded by the render; transparent rows as dots.

    Args:
        model: The map.
        view: What a camera there sees, from ``RTGSLAM.render`` or ``RTGSLAM.surface``.
        camera, T_WC: The camera and pose that it is seen from.
    """
    table = np.array([STATE_COLOURS["unstable_opaque"], STATE_COLOURS["stable_opaque"], _NOTHING], np.float32)
    assert view.hit_index is not None
    hit = view.hit_index.cpu()
    state = torch.where(hit >= 0, model.state.cpu()[hit.clamp_min(0).long()].long(), 2) if len(model) else hit * 0 + 2
    light = view.rgb.cpu().clamp(0, 1).mean(-1).numpy()
    shade = np.where(state.numpy() == 2, 1.0, 0.55 + 0.45 * light)
    picture = (table[state.numpy()] * shade[..., None]).astype(np.uint8)
    for name, stable in (("unstable_transparent", False), ("stable_transparent", True)):
        paint_rows(
            picture, model, model.is_transparent & (model.is_stable == stable), STATE_COLOURS[name], camera, T_WC
        )
    return picture


def cause_picture(photo: AnyImage, model: SurfelModel, frame: Frame) -> Picture:
    """The photograph in grey, with the Gaussians added at this frame as dots in the colour of their cause."""
    grey = to_uint8(photo).mean(-1, keepdims=True)
    picture = np.repeat((60 + 0.55 * grey).astype(np.uint8), 3, axis=-1)
    born = model.birth_frame == frame.index
    for tag, (_, ink) in CAUSES.items():
        paint_rows(picture, model, born & (model.tag == tag), ink, frame.camera, frame.T_WC)
    return picture


def paint_rows(
    picture: Picture, model: GaussianModel, rows: Bool[Tensor, " N"], ink: tuple[int, ...], camera: Camera, T_WC: Tensor
) -> None:
    """Draw a dot of two by two pixels at the centre of each of the given Gaussians, in place."""
    xyz_W = model.params.xyz_W[rows]
    xyz_C = se3.apply(se3.inverse(T_WC.to(xyz_W)), xyz_W)
    uv = project(camera, xyz_C[xyz_C[:, 2] > 0]).cpu().numpy()
    uv = np.floor(uv[np.isfinite(uv).all(1)]).clip(-9, 1e6).astype(int)
    for dx in (0, 1):
        for dy in (0, 1):
            x, y = uv[:, 0] + dx, uv[:, 1] + dy
            inside = (x >= 0) & (y >= 0) & (x < picture.shape[1]) & (y < picture.shape[0])
            picture[y[inside], x[inside]] = ink
