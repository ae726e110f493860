"""Which Gaussians a camera sees, and how large they are in its image.

Cases of ``footprints``: Gaussians before, beside and behind the camera, some that are not drawn,
and none.
"""

import functools
from collections.abc import Iterator

import torch
from torch import Tensor

from gsfusion_nb.render import footprints
from gsfusion_nb.render.constants import NEAR_PLANE_M

from . import Case, make_frame, make_params
from .rasterize import break_rows


def cases() -> Iterator[Case]:
    """One with everything, and one of an empty map."""
    yield Case(
        name="all around",
        operations=("footprints",),
        run=functools.partial(_run, 600),
        flips=2e-3,
    )
    yield Case(
        name="a nearer near plane",
        operations=("footprints",),
        run=functools.partial(_run, 600, near_m=0.05),
        flips=2e-3,
    )
    yield Case(
        name="0 Gaussians",
        operations=("footprints",),
        run=functools.partial(_run, 0),
    )


def _run(
    n: int,
    device: torch.device,
    dtype: torch.dtype,
    near_m: float = NEAR_PLANE_M,
) -> dict[str, Tensor]:
    params = make_params(1, device, dtype, n)
    frame = make_frame(device)
    if n:
        params.xyz_W.mul_(3.0)
        params.xyz_W[::5, 2] -= 5.0
        params.opacity_logit[::7] = -6.0
        params.xyz_W[::3] *= 0.04  # between the two planes
        break_rows(params)
    seen = footprints(params, frame.camera, frame.T_WC, near_m)
    return {"visible": seen.visible, "radius_px": seen.radius_px}
