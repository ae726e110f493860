"""Lists of the Gaussians that touch each tile, a stage of rasterize.

Cases of ``tile_intersections``: every tile lists the Gaussians that it shows, nearest first.
"""

import functools
from collections.abc import Iterator

import torch
from torch import Tensor

from gsfusion_nb.geometry import pixel_grid
from gsfusion_nb.render import Projection, project_gaussians, tile_intersections
from gsfusion_nb.render.constants import ALPHA_MIN
from gsfusion_nb.types import Camera

from ..runtime.cases import HEIGHT, WIDTH, Case, make_frame, make_params


def cases() -> Iterator[Case]:
    """Tiles that fit the image and tiles that do not; some pixels; maps of no, one and a few hundred Gaussians."""
    for tile_px in (5, 8, 16):
        yield _case(f"tiles of {tile_px} pixels", tile_px=tile_px)
    yield _case("some pixels", masked=True)
    for n in (0, 1, 400):
        yield _case(f"{n} Gaussians", n=n)


def _case(name: str, **options) -> Case:
    return Case(name=name, operations=("tile_intersections",), run=functools.partial(_run, **options))


def _run(
    device: torch.device, dtype: torch.dtype, *, n: int = 50, tile_px: int = 8, masked: bool = False
) -> dict[str, Tensor]:
    """Which of the pairs that are seen are listed: a backend may list more pairs than another."""
    params, frame = make_params(0, device, dtype, n), make_frame(device)
    p = project_gaussians(params, frame.camera, frame.T_WC.to(dtype))
    pixels = torch.zeros(HEIGHT, WIDTH, dtype=torch.bool, device=device)
    pixels[7:30, 20:43] = True
    tiles = tile_intersections(p, frame.camera, tile_px=tile_px, pixels=pixels if masked else None)
    seen = _seen(p, frame.camera, pixels if masked else pixels | True)
    i, j = torch.arange(HEIGHT, device=device) // tile_px, torch.arange(WIDTH, device=device) // tile_px
    tile_of = (i[:, None] * tiles.tiles_x + j).expand(n, -1, -1)
    count = tiles.tiles_x * tiles.tiles_y
    needed = torch.zeros(n, count, device=device).scatter_add(1, tile_of.flatten(1), seen.flatten(1).float()) > 0
    listed = torch.zeros(n, count, dtype=torch.bool, device=device)
    falls = torch.zeros(count, dtype=torch.int64, device=device)
    for tile in range(count):
        rows = tiles.gaussians_of(tile)
        listed[rows, tile] = True
        falls[tile] = (p.depth_m[rows].diff() < 0).sum()
    return {"listed": (listed & needed).long(), "missing": (needed & ~listed).long(), "falls in depth": falls}


def _seen(p: Projection, camera: Camera, pixels: Tensor) -> Tensor:
    """Whether each Gaussian reaches an alpha a little above 1/255 at each of the pixels. [N, H, W]"""
    dx, dy = (pixel_grid(camera, dtype=p.uv.dtype, device=p.uv.device)[None] - p.uv[:, None, None]).unbind(-1)
    A, B, C, o = (x[:, None, None] for x in (*p.conic.unbind(1), p.opacity))
    alpha = o * torch.exp(-(A * dx * dx + C * dy * dy) / 2 - B * dx * dy)
    return (alpha > 1.001 * ALPHA_MIN) & p.visible[:, None, None] & pixels
