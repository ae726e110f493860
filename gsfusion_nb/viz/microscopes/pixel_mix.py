"""What is mixed in a pixel of GPS-SLAM: the surface and the Gaussians over it, in any order."""

import dataclasses
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from markupsafe import Markup
from torch import Tensor

from ...drawing.html import html_table
from ...render import BaseView
from ...render.composite import pixel_offsets, splat_alpha
from ...render.over_base import not_behind
from .pixel_stack import CELL_STYLE, TABLE_ROWS, Splats, check_pixel, rgb_text, swatch


@dataclass(frozen=True, kw_only=True, eq=False)
class PixelMix:
    """The surface and the K Gaussians of one pixel, with their weights. A notebook shows it as a table."""

    u: int
    """Pixel column."""
    v: int
    """Pixel row."""
    base_rgb: Float[Tensor, "3"]
    """C_s."""
    base_weight: float
    """b; 1 but where a hole counts nothing."""
    row: Int[Tensor, " K"]
    depth_m: Float[Tensor, " K"]
    weight: Float[Tensor, " K"]
    """w_k."""
    rgb: Float[Tensor, "K 3"]
    """c_k."""
    hidden: int
    """Gaussians that reach the pixel and lie behind the surface: their weight is 0."""

    def __len__(self) -> int:
        return self.row.shape[0]

    @property
    def total(self) -> float:
        """W, the sum of the Gaussians' weights."""
        return float(self.weight.sum())

    @property
    def running(self) -> Float[Tensor, "M 3"]:
        """The colour of the surface, then with the first Gaussian, and so on to the pixel's. [K + 1, 3]"""
        one = torch.cat([self.weight.new_tensor([self.base_weight]), self.weight])
        colours = torch.cat([self.base_rgb[None], self.rgb])
        return (one[:, None] * colours).cumsum(0) / one.cumsum(0).clamp_min(1e-9)[:, None]

    @property
    def colour(self) -> Float[Tensor, "3"]:
        """(b C_s + sum w_k c_k) / (b + W): the colour of the pixel."""
        return self.running[-1]

    def shuffled(self, generator: torch.Generator) -> "PixelMix":
        """The same Gaussians in a random order."""
        order = torch.randperm(len(self), generator=generator)
        parts = {name: getattr(self, name)[order] for name in ("row", "depth_m", "weight", "rgb")}
        return dataclasses.replace(self, **parts)

    def __repr__(self) -> str:
        r, g, b = self.colour.tolist()
        return (
            f"PixelMix(pixel ({self.u}, {self.v}), surface and {len(self)} Gaussians, W {self.total:.2f}, "
            f"colour {r:.3f} {g:.3f} {b:.3f})"
        )

    def _repr_html_(self) -> str:
        return mix_table(self)


def pixel_mix(splats: Splats, below: BaseView, u: int, v: int) -> PixelMix:
    """What is mixed in pixel (column ``u``, row ``v``), the heaviest Gaussian first.

    Raises:
        ValueError: the pixel is not in the picture.
    """
    check_pixel(splats.camera, u, v)
    p, base = splats.projection, below.base
    centre = p.uv.new_tensor([u + 0.5, v + 0.5])
    row = (p.visible & ((p.uv - centre).abs() <= p.extent_px).all(1)).nonzero().squeeze(1)
    dx, dy = pixel_offsets(p.uv[row], torch.tensor([u]), torch.tensor([v]))
    alpha = splat_alpha(dx, dy, p.conic[row], p.opacity[row])[:, 0]
    row, alpha = row[alpha > 0], alpha[alpha > 0]
    w = not_behind(alpha[:, None], p.depth_m[row], base.depth_m[v, u][None], below.behind_m)[:, 0]
    hidden = w == 0
    row, w = row[~hidden], w[~hidden]
    order = w.argsort(descending=True, stable=True)
    row, w = row[order], w[order]
    return PixelMix(
        u=u, v=v, base_rgb=base.rgb[v, u], base_weight=float(base.weight[v, u]), row=row, depth_m=p.depth_m[row],
        weight=w, rgb=splats.rgb[row], hidden=int(hidden.sum()),
    )  # fmt: skip


def mix_table(mix: PixelMix, rows: int = TABLE_ROWS) -> str:
    """The mix as an HTML table: surface, Gaussians, and the mean below."""
    share = 1 / max(mix.base_weight + mix.total, 1e-9)
    lines: list[tuple[str, ...]] = [_line("", "surface", "", mix.base_weight, mix.base_rgb, share)]
    shown = min(len(mix), rows)
    for k in range(shown):
        lines.append(
            _line(str(k), str(int(mix.row[k])), f"{mix.depth_m[k]:.3f}", float(mix.weight[k]), mix.rgb[k], share)
        )
    if shown < len(mix):
        rest = float(mix.weight[shown:].sum())
        lines.append(("", f"… {len(mix) - shown} more", "", f"{rest:.3f}", f"{rest * share:.0%}", "", ""))
    total = mix.base_weight + mix.total
    mean = ("", "mean", "", f"{total:.3f}", "100%", swatch(mix.colour), rgb_text(mix.colour))
    lines.append(tuple(Markup("<b>{}</b>").format(x) for x in mean))
    heads = ("k", "row", "depth m", "weight", "share", "", "colour")
    return html_table(lines, heads=heads, name="gsnb-stack", style="font-size:12px", cell_style=CELL_STYLE)


def _line(k: str, row: str, depth: str, weight: float, rgb: Tensor, share: float) -> tuple[str, ...]:
    return k, row, depth, f"{weight:.3f}", f"{weight * share:.0%}", swatch(rgb), rgb_text(rgb)
