"""Two boards covered with discs, whose depth is known: the scene of the panel of disc depth."""

import dataclasses

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ...config import DiscConfig
from ...gaussians.surfels import OPAQUE
from ...geometry import quaternion
from ...geometry.spherical_harmonics import rgb_to_sh_dc
from ...render import view_surface
from ...types import Camera, GaussianParams

STAGE_CAMERA = Camera(
    width=96,
    height=60,
    fx=80.0,
    fy=80.0,
    cx=48.0,
    cy=30.0,
)
NEAR_M = 1.2
"""The right edge of the front board is at x = 0 and this far away, metres."""
MID_AIR_M = 0.03
_HALF_M = 0.7
_ROWS_M = 0.8


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class DiscScene:
    """Two boards covered with discs, seen from the origin, and what a camera sees of them."""

    params: GaussianParams
    truth_m: Float[Tensor, "H W"]
    """z-depth of the boards."""
    planes_m: tuple[Float[Tensor, "H W"], ...]
    """z-depth of the planes that the boards lie in."""
    disc_m: Float[Tensor, "H W"]
    """Depth of the discs that the rays hit (Eq. 4-5); 0 where there is none."""
    blended_m: Float[Tensor, "H W"]
    """sum of w_k z_k / alpha."""
    rgb: Float[Tensor, "H W 3"]

    def errors_m(self, name: str) -> Float[Tensor, " M"]:
        """|depth - truth| on the board where there is a depth; ``name`` is "disc_m" or
        "blended_m"."""
        depth = getattr(self, name)
        return (depth - self.truth_m)[(depth > 0) & (self.truth_m == self.planes_m[0])].abs()

    def in_mid_air(self, name: str) -> float:
        """Share of the depths that are more than 3 cm from every surface."""
        depth = getattr(self, name)
        distance_m = torch.stack([(depth - plane).abs() for plane in self.planes_m]).amin(0)
        return float((distance_m[depth > 0] > MID_AIR_M).float().mean())


def disc_scene(
    *,
    lean_deg: float | int = 30,
    gap_m: float | int = 0.6,
    spacing_m: float | int = 0.1,
    opaque_alpha: float = 0.3,
) -> DiscScene:
    """A tilted board in front of a wall, both covered with discs of standard deviation spacing /
    1.5.

    Args:
        lean_deg: Rotation of the front board about the vertical, degrees.
        gap_m: Distance of the wall behind it, metres; 0: only the board.
        spacing_m: Distance of neighbouring discs, metres.
        opaque_alpha: A ray hits a disc where its alpha is at least this.
    """
    camera = STAGE_CAMERA
    T_WC = torch.eye(4)
    lean = np.radians(float(lean_deg))
    front = _board(
        lean,
        NEAR_M,
        (-_HALF_M, 0.0 if gap_m > 0 else _HALF_M),
        float(spacing_m),
        (0.93, 0.62, 0.36),
    )
    parts = [front]
    if gap_m > 0:
        parts.append(
            _board(
                0.0,
                NEAR_M + gap_m,
                (-1.4, 1.4),
                float(spacing_m) * 1.3,
                (0.36, 0.55, 0.75),
            )
        )
    params = GaussianParams(**{k: torch.cat([vars(p)[k] for p in parts]) for k in vars(front)})
    config = DiscConfig(opaque_alpha=opaque_alpha, min_cosine=0.17, max_offset=3.0)
    view = view_surface(params, camera, T_WC, config)
    blended_view = view_surface(params, camera, T_WC, dataclasses.replace(config, depth="blended"))
    planes = _planes(camera, lean, float(gap_m))
    return DiscScene(
        params=params,
        truth_m=_truth(camera, lean, planes),
        planes_m=planes,
        disc_m=view.depth_m,
        blended_m=blended_view.depth_m,
        rgb=view.rgb,
    )


def _board(
    lean: float,
    z_m: float,
    x_m: tuple[float, float],
    spacing_m: float,
    rgb: tuple[float, ...],
) -> GaussianParams:
    """Discs on a plane through (0, 0, z) that is turned by ``lean`` about the vertical; the left
    side is farther."""
    u = torch.arange(x_m[0] + spacing_m / 2, x_m[1], spacing_m)
    v = torch.arange(-_ROWS_M, _ROWS_M + spacing_m / 2, spacing_m)
    u, v = (a.flatten() for a in torch.meshgrid(u, v, indexing="ij"))
    direction = torch.tensor(
        [np.cos(lean), 0.0, -np.sin(lean)],
        dtype=torch.float32,
    )
    normal = torch.tensor(
        [-np.sin(lean), 0.0, -np.cos(lean)],
        dtype=torch.float32,
    )
    xyz = (
        u[:, None] * direction
        + v[:, None] * torch.tensor([0.0, 1.0, 0.0])
        + torch.tensor([0.0, 0.0, z_m])
    )
    n = len(u)
    checks = 0.82 + 0.18 * ((u / spacing_m).round() + (v / spacing_m).round()).remainder(2)
    colour = checks[:, None] * torch.tensor(rgb)
    z_axis = torch.tensor([0.0, 0.0, 1.0]).expand(n, 3)
    sigma = spacing_m / 1.5
    return GaussianParams(
        xyz_W=xyz,
        log_scale=torch.tensor([sigma, sigma, 0.1 * sigma]).log().expand(n, 3).clone(),
        quat=quaternion.shortest_arc(z_axis, normal.expand(n, 3)),
        opacity_logit=torch.full((n,), float(torch.logit(torch.tensor(OPAQUE)))),
        sh=rgb_to_sh_dc(colour)[:, None],
    )


def _planes(
    camera: Camera,
    lean: float,
    gap_m: float,
) -> tuple[Float[Tensor, "H W"], ...]:
    """z-depth of the board's plane, x tan(lean) + z = z0, and of the wall's along the rays."""
    x = ((torch.arange(camera.width) + 0.5 - camera.cx) / camera.fx).expand(camera.height, -1)
    board = (NEAR_M / (1 + x * float(np.tan(lean)))).contiguous()
    return (board, torch.full_like(board, NEAR_M + gap_m)) if gap_m > 0 else (board,)


def _truth(
    camera: Camera, lean: float, planes: tuple[Float[Tensor, "H W"], ...]
) -> Float[Tensor, "H W"]:
    """z-depth of the boards: the front one is between x = -0.7 cos(lean) and 0 if there is a
    wall."""
    board = planes[0]
    wall = planes[-1]
    x_m = (torch.arange(camera.width) + 0.5 - camera.cx) / camera.fx * board
    on_board = (board > 0) & (x_m <= 0) & (x_m >= -_HALF_M * float(np.cos(lean)))
    return torch.where(on_board, torch.minimum(board, wall), wall)
