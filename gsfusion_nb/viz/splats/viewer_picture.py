"""What the splat viewer shows, drawn by the library's own renderer: the picture of a stored notebook."""

import dataclasses

import torch
from jaxtyping import Float
from torch import Tensor

from ...drawing.pictures import Picture, colour_stops, to_uint8
from ...geometry.spherical_harmonics import rgb_to_sh_dc
from ...render import render
from ...types import Camera, GaussianParams
from .columns import STATE_NAMES
from .map_picture import draw_gaussians
from .surfel_pictures import STATE_COLOURS

PALETTES = ("turbo", "viridis", "state")
"""Depth, numbers, and the two states in the colours of ``state_picture``."""


def palette_stops(name: str) -> list[str]:
    """256 colours as "#rrggbb"."""
    if name != "state":
        return colour_stops(name, 256)
    unstable, stable = ("#" + bytes(STATE_COLOURS[f"{name}_opaque"]).hex() for name in STATE_NAMES)
    return [unstable] * 128 + [stable] * 128


def painted(
    params: GaussianParams, values: Float[Tensor, " N"], low: float, high: float, palette: str = "viridis"
) -> GaussianParams:
    """The same Gaussians, each with the colour of its number between ``low`` and ``high``."""
    stops = [[int(stop[i : i + 2], 16) / 255 for i in (1, 3, 5)] for stop in palette_stops(palette)]
    level = ((values - low) / max(high - low, 1e-9) * 255).round().clamp(0, 255).long()
    sh = rgb_to_sh_dc(torch.tensor(stops).to(params.sh)[level.to(params.sh.device)])
    return dataclasses.replace(params, sh=sh[:, None])


def splat_picture(
    params: GaussianParams,
    camera: Camera,
    T_WC: Float[Tensor, "4 4"],
    *,
    paint: tuple[Float[Tensor, " N"], float, float, str] | None = None,
    depth: bool = False,
    size: float = 1.0,
    opacity: float = 1.0,
    background: Float[Tensor, "3"] | None = None,
) -> Picture:
    """The map from a camera, with the viewer's settings.

    Args:
        params, camera, T_WC: as for ``render``.
        paint: One number per Gaussian, the numbers of the first and the last colour, and a palette; ``None``: own
            colours.
        depth: Show expected depth instead.
        size: Multiplies every standard deviation.
        opacity: Multiplies every opacity (clamped below 1).
        background: Behind the map, 0..1; black by default.
    """
    if paint is not None:
        params = painted(params, *paint)
    if size != 1 or opacity != 1:
        o = (params.opacity_logit.sigmoid() * opacity).clamp(1e-6, 1 - 1e-6)
        log_size = torch.tensor(size).log().item()
        params = dataclasses.replace(params, log_scale=params.log_scale + log_size, opacity_logit=o.logit())
    if depth:
        return draw_gaussians(params, camera, T_WC, "depth")
    view = render(params, camera, T_WC)
    if background is None:
        return to_uint8(view.rgb)
    return to_uint8(view.rgb + (1 - view.alpha[..., None]) * background.to(view.rgb))
