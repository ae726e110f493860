"""One Gaussian, enlarged: the exact projection of its points beside the ellipse that is drawn."""

import math

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ...drawing.ground import CARD, CARD_INK
from ...drawing.pictures import Picture, to_uint8
from ...geometry import project, quaternion
from ...geometry.spherical_harmonics import rgb_to_sh_dc, sh_basis
from ...render import render, tile_intersections
from ...types import Camera, GaussianParams
from .pixel_stack import Splats, project_splats
from .stack_picture import outlines

ORANGE, WHITE = (255, 150, 40), (255, 255, 255)


def gaussian_row(
    xyz_W: Float[Tensor, "3"],
    scale_m: Float[Tensor, "3"],
    quat: Float[Tensor, "4"],
    *,
    opacity: float = 0.9,
    rgb: tuple[float, float, float] = (0.25, 0.55, 0.9),
) -> GaussianParams:
    """A map of one Gaussian from activated values, with the same colour from every direction."""
    return GaussianParams(
        xyz_W=xyz_W[None].float(),
        log_scale=scale_m[None].float().log(),
        quat=quat[None].float(),
        opacity_logit=torch.tensor([opacity]).logit(),
        sh=rgb_to_sh_dc(torch.tensor([[rgb]])),
    )


def orientation_from_angles(turn_deg: float | int, lean_deg: float | int) -> Float[Tensor, "4"]:
    """Orientation: ``turn_deg`` about the viewing axis z after ``lean_deg`` about the vertical axis y."""
    turn, lean = math.radians(turn_deg) / 2, math.radians(lean_deg) / 2
    about_z = torch.tensor([math.cos(turn), 0.0, 0.0, math.sin(turn)])
    about_y = torch.tensor([math.cos(lean), 0.0, math.sin(lean), 0.0])
    return quaternion.multiply(about_z, about_y)


def projection_picture(
    params: GaussianParams, camera: Camera, *, zoom: int = 6, n_points: int = 400
) -> tuple[Picture, Splats]:
    """One Gaussian, rendered by a camera at the origin; its ellipses; and points drawn from it, projected exactly.

    The blue blob is what the renderer draws, white are the ellipses of one and two standard deviations, orange are the
    exact projections of points of the 3D Gaussian. Where points and ellipse disagree, the linearisation of EWA fails.

    Args:
        params: One row.
        camera: Its picture is small, so that pixels can be seen.
        zoom: Screen pixels per pixel.
        n_points: Number of points; they are the same each time.

    Returns:
        The picture and the splat's numbers.
    """
    import cv2

    splats = project_splats(params, camera, torch.eye(4))
    view = to_uint8(0.12 + 0.88 * render(params, camera, torch.eye(4)).rgb)
    image = np.asarray(cv2.resize(view, None, fx=zoom, fy=zoom, interpolation=cv2.INTER_NEAREST), np.uint8)
    for u, v in _cloud_uv(params, camera, n_points):
        cv2.circle(image, (round(u * zoom), round(v * zoom)), 1, ORANGE, -1, cv2.LINE_AA)
    if bool(splats.projection.visible[0]):
        ring = outlines(splats, torch.tensor([0]))[0]
        centre = splats.projection.uv[0].double().numpy()
        for k in (1, 2):
            points = ((centre + k * (ring - centre)) * zoom * 16).round().clip(-1e6, 1e6).astype(np.int32)
            cv2.polylines(image, [points], True, WHITE, 1, cv2.LINE_AA, shift=4)
    return image, splats


def projection_caption(splats: Splats) -> str:
    """Covariance, angle and tiles of the only Gaussian, as HTML."""
    p = splats.projection
    if not bool(p.visible[0]):
        return "<b>not drawn</b>: nearer than the near plane, or too faint"
    A, B, C = p.conic[0].double().tolist()
    det = A * C - B * B
    uu, uv, vv = C / det, -B / det, A / det
    n = len(tile_intersections(p, splats.camera).gaussian)
    return (
        f"cov<sub>2D</sub> = [{uu:.1f} {uv:.1f}; {uv:.1f} {vv:.1f}] px²<br>"
        f"centre ({p.uv[0, 0]:.1f}, {p.uv[0, 1]:.1f}) px, area of 1σ {math.pi / math.sqrt(det):.0f} px²<br>"
        f"in the lists of {n} tiles"
    )


def sh_ball(sh: Float[Tensor, "K 3"], size: int = 160) -> Picture:
    """The colour of one Gaussian from all sides, painted on a ball: each point has the colour seen from that side.

    The ball is seen by a camera that looks along +z, x to the right, y down. A viewer in the direction of the normal n
    looks along d = -n, which is the direction that the harmonics are evaluated at.
    """
    n, inside = _ball_normals(size)
    degree = round(sh.shape[0] ** 0.5) - 1
    colour = (sh_basis(-n, degree) @ sh + 0.5).clamp(0, 1)
    image = (torch.tensor(CARD) / 255).repeat(size * size, 1)
    image[inside] = colour
    return to_uint8(image.view(size, size, 3))


def basis_atlas(size: int = 104) -> Picture:
    """The 16 basis functions on balls, one row per degree: red where positive, blue where negative."""
    import cv2

    n, inside = _ball_normals(size)
    Y = sh_basis(-n, 3)
    atlas = np.full((4 * size, 7 * size, 3), CARD, np.uint8)
    for k in range(16):
        degree = math.isqrt(k)
        column = 3 - degree + k - degree * degree
        value = (Y[:, k] / 0.9).clamp(-1, 1)[:, None]
        red, blue = torch.tensor([0.82, 0.1, 0.1]), torch.tensor([0.1, 0.3, 0.85])
        colour = 1 - value.abs() * (1 - torch.where(value > 0, red, blue))
        tile = (torch.tensor(CARD) / 255).repeat(size * size, 1)
        tile[inside] = colour
        y, x = degree * size, column * size
        atlas[y : y + size, x : x + size] = to_uint8(tile.view(size, size, 3))
        cv2.circle(atlas, (x + size // 2, y + size // 2), round(0.44 * size), (150, 156, 166), 1, cv2.LINE_AA)
        cv2.putText(atlas, f"Y{k}", (x + 3, y + 13), cv2.FONT_HERSHEY_SIMPLEX, 0.4, CARD_INK, 1, cv2.LINE_AA)
    return atlas


def _cloud_uv(params: GaussianParams, camera: Camera, n: int) -> list[list[float]]:
    """Exact projections of points drawn from the first Gaussian; those behind the camera are left out."""
    unit = torch.randn(n, 3, generator=torch.Generator().manual_seed(0))
    R = quaternion.to_matrix(params.quat[0])
    xyz = params.xyz_W[0] + (unit * params.log_scale[0].exp()) @ R.T
    xyz = xyz[xyz[:, 2] > 0.05]
    uv = project(camera, xyz)
    inside = (uv > 0).all(1) & (uv[:, 0] < camera.width) & (uv[:, 1] < camera.height)
    return uv[inside].tolist()


def _ball_normals(size: int) -> tuple[Tensor, Tensor]:
    """Outward normals of the visible half of a ball, and which pixels of the square show it."""
    i = (torch.arange(size) + 0.5 - size / 2) / (0.44 * size)
    y, x = torch.meshgrid(i, i, indexing="ij")
    inside = (x * x + y * y < 1).flatten()
    x, y = x.flatten()[inside], y.flatten()[inside]
    return torch.stack([x, y, -(1 - x * x - y * y).sqrt()], -1), inside
