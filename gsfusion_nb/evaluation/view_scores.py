"""Scores of pictures of the map against frames, one view and the mean of many."""

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from ..checks import check_shape
from ..types import Camera, Frame, RenderOutput
from .image import (
    BORDER_PX,
    both_on_8bit_grid,
    exact_mean,
    psnr_of_levels,
    ssim_map,
    without_border,
)
from .learned_distance import lpips, lpips_as_released
from .metrics import NotComputed

RenderFn = Callable[[Camera, Tensor], RenderOutput]
"""Renders a map for a camera at pose T_WC. It does not receive the frame, so its pixels cannot
influence the result."""


def depth_l1_m(
    depth_m: Float[Tensor, "H W"], reference_m: Float[Tensor, "H W"]
) -> tuple[float, float]:
    """Mean |depth - reference|, metres, over the pixels that have depth in both, and the share of
    these pixels.

    Returns:
        ``(l1_m, share)``; the error is NaN when no pixel has both, and when a depth that is
        compared is NaN.

    Differentiable: no.
    """
    check_shape("depth_m", depth_m, tuple(reference_m.shape))
    both = ~(depth_m <= 0) & (reference_m > 0)  # with those that are NaN, which must not disappear
    share = float(both.double().mean()) if both.numel() else 0.0
    error = (depth_m[both].double() - reference_m[both].double()).abs()
    return (exact_mean(error) if len(error) else math.nan), share


def expected_depth_m(view: RenderOutput, *, alpha_min: float = 0.5) -> Float[Tensor, "H W"]:
    """Depth of the map, metres; 0 (missing) where it has none: ``surface_depth_m`` if the map has
    it, else blended depth / opacity where the opacity is at least ``alpha_min``."""
    if view.surface_depth_m is not None:
        return view.surface_depth_m
    covered = view.alpha >= alpha_min
    return torch.where(
        covered, view.depth_m / view.alpha.clamp_min(1e-6), torch.zeros_like(view.depth_m)
    )


@dataclass(frozen=True, kw_only=True)
class ViewScores:
    """Scores of one view."""

    index: int
    """Frame number in the source sequence."""
    psnr: float
    """dB; NaN if the render has a NaN."""
    ssim: float
    """NaN for images with a side of less than 6 pixels, which are too small for its window."""
    lpips: float | NotComputed
    ssim_as_released: float
    """NaN for images with a side of less than 11 pixels."""
    lpips_as_released: float | NotComputed
    depth_l1_m: float
    """Metres; NaN if no pixel has both depths, or a rendered one is NaN."""


@dataclass(frozen=True, kw_only=True)
class ImageScores:
    """Scores of many views: the rows, and their means as properties."""

    rows: tuple[ViewScores, ...]

    def __len__(self) -> int:
        return len(self.rows)

    @property
    def psnr(self) -> float | NotComputed:
        """Mean of the per-image PSNR, dB."""
        return self.mean("psnr")

    @property
    def ssim(self) -> float | NotComputed:
        """Mean SSIM."""
        return self.mean("ssim")

    @property
    def depth_l1_m(self) -> float | NotComputed:
        """Mean of the per-image depth error, metres, over the views that have one
        (``without("depth_l1_m")``)."""
        return self.mean("depth_l1_m")

    @property
    def not_a_number(self) -> tuple[int, ...]:
        """Frame numbers of the views whose render has a NaN; no mean of pictures counts them."""
        return self.without("psnr")

    def without(self, name: str) -> tuple[int, ...]:
        """Frame numbers of the views whose field ``name`` is NaN, which ``mean`` does not count."""
        values = [(row.index, getattr(row, name)) for row in self.rows]
        return tuple(
            index for index, v in values if not isinstance(v, NotComputed) and math.isnan(v)
        )

    def mean(self, name: str) -> float | NotComputed:
        """Mean of a field of ``ViewScores`` over the views that have it, or the reason why there is
        none.

        The views that it leaves out are ``without(name)``; ``as_metrics`` has their numbers.
        """
        values = [getattr(row, name) for row in self.rows]
        missing = [v for v in values if isinstance(v, NotComputed)]
        if missing:
            return missing[0]
        known = [v for v in values if not math.isnan(v)]
        if not known:
            return NotComputed(self._reason_without(name) if values else "no view to score")
        return sum(known) / len(known)

    def _reason_without(self, name: str) -> str:
        """Why no view has the field ``name``."""
        if len(self.not_a_number) == len(self):
            return "the render of every view has a NaN"
        return (
            "no view has both depths"
            if name == "depth_l1_m"
            else "the images are too small for its window"
        )

    def as_metrics(self, suffix: str) -> dict[str, float | NotComputed]:
        """The means with the names of the metrics table, for example ``psnr_held_out_db`` for
        suffix "held_out".

        If means leave views out, ``n_views_nan_held_out`` and ``n_views_no_depth_held_out`` say how
        many.
        """
        missing = {"nan": self.not_a_number, "no_depth": self.without("depth_l1_m")}
        return {
            f"n_views_{why}_{suffix}": float(len(views)) for why, views in missing.items() if views
        } | {
            f"psnr_{suffix}_db": self.psnr,
            f"ssim_{suffix}": self.ssim,
            f"lpips_{suffix}": self.mean("lpips"),
            f"ssim_as_released_{suffix}": self.mean("ssim_as_released"),
            f"lpips_as_released_{suffix}": self.mean("lpips_as_released"),
            f"depth_l1_{suffix}_m": self.depth_l1_m,
        }


def score_view(view: RenderOutput, frame: Frame, *, with_lpips: bool = False) -> ViewScores:
    """Compare the map's picture of one view with the frame; arguments and scores are those of
    ``score_views``."""
    frame = frame.to(view.rgb.device)
    images = (view.rgb, frame.rgb)
    prepared = both_on_8bit_grid(*images)
    side = min(frame.rgb.shape[:2])
    l1_m, _ = depth_l1_m(expected_depth_m(view), frame.depth_m)
    similarity = ssim_map(*prepared) if side >= 6 else torch.full((1, 1, 3), math.nan)
    not_requested = NotComputed("not requested")
    return ViewScores(
        index=frame.index,
        psnr=psnr_of_levels(*prepared),
        ssim=exact_mean(similarity),
        lpips=lpips(*images) if with_lpips else not_requested,
        ssim_as_released=exact_mean(without_border(similarity))
        if side > 2 * BORDER_PX
        else math.nan,
        lpips_as_released=lpips_as_released(*images) if with_lpips else not_requested,
        depth_l1_m=l1_m,
    )


def score_views(
    render_fn: RenderFn, frames: Iterable[Frame], *, with_lpips: bool = False
) -> ImageScores:
    """Render every frame's view and compare it with the frame, reading the frames one by one.

    Args:
        render_fn: ``(camera, T_WC) -> RenderOutput``.
        frames: The views to score, in any order; only one is held in memory at a time.
        with_lpips: Also compute LPIPS, both ways (about 0.2 s per view on a CPU).

    Returns:
        One row per frame. Depth is compared where the opacity of the map is at least 0.5.
    """
    rows = []
    for frame in frames:
        with torch.no_grad():
            view = render_fn(frame.camera, frame.T_WC)
        rows.append(score_view(view, frame, with_lpips=with_lpips))
    return ImageScores(rows=tuple(rows))
