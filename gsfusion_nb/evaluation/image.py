"""Difference between a rendered and a recorded image: PSNR, SSIM, LPIPS, depth error, and the
scores of many views.

Images are RGB in 0..1, not cropped and not masked; an average over views is the mean of the
per-image numbers.
"""

import functools
import math
import warnings
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from ..checks import check_shape
from ..errors import ArgumentError
from ..geometry import sum_rows
from ..types import Camera, Frame, RenderOutput
from .metrics import NotComputed

WINDOW_PX = 11
SIGMA_PX = 1.5
"""SSIM's Gaussian window and its standard deviation, pixels."""
C1 = 0.01**2
C2 = 0.03**2
"""SSIM's constants for images in 0..1."""
BORDER_PX = 5
"""Half of SSIM's window of 11 pixels, rounded down: nearer to the border the window is cut."""

RenderFn = Callable[[Camera, Tensor], RenderOutput]
"""Renders a map for a camera at pose T_WC. It does not receive the frame, so its pixels cannot
influence the result."""


def to_8bit_grid(rgb: Float[Tensor, "H W 3"]) -> Float[Tensor, "H W 3"]:
    """Clamp to 0..1 and round to the 256 levels of an 8-bit image, halves up. Differentiable:
    no."""
    return (rgb.clamp(0, 1) * 255 + 0.5).floor() / 255


def _prepared(rgb: Tensor, reference: Tensor) -> tuple[Tensor, Tensor]:
    """Both rounded to 8 bits, as when a render is stored and read back before it is scored."""
    check_shape("rgb", rgb, tuple(reference.shape))
    return to_8bit_grid(rgb), to_8bit_grid(reference)


def _mean(values: Tensor) -> float:
    """The mean in double precision, the same with any number of threads."""
    return float(sum_rows(values.double().flatten()) / values.numel())


def psnr(rgb: Float[Tensor, "H W 3"], reference: Float[Tensor, "H W 3"]) -> float:
    """Peak signal-to-noise ratio, dB:  -10 log10 mean((a - b)^2), data range 1.

    Args:
        rgb: Image, 0..1 (clamped, and rounded to 8 bits, as all metrics do). [H, W, 3]
        reference: The image to compare with. [H, W, 3]

    Returns:
        Decibels; infinite for equal images.

    Differentiable: no. Source: the protocol of GSFusion's evaluation (torchmetrics, data range 1,
    8-bit images).
    """
    return _psnr(*_prepared(rgb, reference))


def _psnr(a: Tensor, b: Tensor) -> float:
    """PSNR of prepared images."""
    mse = _mean((a.double() - b.double()).square())
    return math.inf if mse == 0 else -10.0 * math.log10(mse)


def ssim(rgb: Float[Tensor, "H W 3"], reference: Float[Tensor, "H W 3"]) -> float:
    """Structural similarity: mean over pixels and channels of the map with an 11x11 Gaussian
    window, sigma 1.5.

    C1 = 0.01^2, C2 = 0.03^2, reflected borders, population variances; the whole map is averaged, as
    torchmetrics does from 1.5.2 on.

    Args:
        rgb: Image, 0..1 (clamped); at least 6 pixels on each side. [H, W, 3]
        reference: The image to compare with. [H, W, 3]

    Returns:
        Between -1 and 1; 1 for equal images.

    Differentiable: no. Source: Wang et al. 2004.
    """
    return _mean(_ssim_map(*_prepared(rgb, reference)))


def ssim_as_released(rgb: Float[Tensor, "H W 3"], reference: Float[Tensor, "H W 3"]) -> float:
    """SSIM as in GSFusion's published tables: ``ssim`` without a border of 5 pixels, where the
    window is cut.

    torchmetrics up to 1.4 and scikit-image leave this border out, and the evaluation released with
    GSFusion uses torchmetrics of that time (its requirements name no version). It differs from
    ``ssim`` in the third digit. Use it only beside published numbers. Arguments and result are
    those of ``ssim``; the images have at least 11 pixels on each side.

    Differentiable: no. Source: GSFusion's released evaluation.
    """
    return _mean(_without_border(_ssim_map(*_prepared(rgb, reference), BORDER_PX + 6)))


def _ssim_map(
    a: Tensor,
    b: Tensor,
    smallest: int = 6,
) -> Float[Tensor, "H W 3"]:
    """SSIM at each pixel of prepared images. On a processor OpenCV filters, in a fifth of the time
    of a convolution."""
    if min(a.shape[:2]) < smallest:
        raise ArgumentError(
            f"rgb must be at least {smallest} pixels high and wide for an 11x11 window, got "
            f"{[*a.shape]}"
        )
    filtered = _filtered_by_opencv if a.device.type == "cpu" else _filtered_by_torch
    mean_a, mean_b, mean_aa, mean_bb, mean_ab = (
        filtered(image) for image in (a, b, a * a, b * b, a * b)
    )
    aa = mean_a * mean_a
    bb = mean_b * mean_b
    ab = mean_a * mean_b
    variances = (mean_aa - aa) + (mean_bb - bb)
    return (2 * ab + C1) * (2 * (mean_ab - ab) + C2) / ((aa + bb + C1) * (variances + C2))


def _filtered_by_opencv(image: Float[Tensor, "H W 3"]) -> Float[Tensor, "H W 3"]:
    """Mean of the window of each pixel; the borders are reflected."""
    import cv2

    x = torch.arange(WINDOW_PX, dtype=image.dtype) - WINDOW_PX // 2
    weights = (-x.square() / (2 * SIGMA_PX**2)).exp()
    window = (weights / weights.sum()).numpy()
    pixels = image.detach().contiguous().numpy()
    return torch.from_numpy(
        cv2.sepFilter2D(pixels, -1, window, window, borderType=cv2.BORDER_REFLECT_101)
    )


def _filtered_by_torch(image: Float[Tensor, "H W 3"]) -> Float[Tensor, "H W 3"]:
    from kornia.filters import gaussian_blur2d

    planes = image.permute(2, 0, 1)[None]
    return gaussian_blur2d(planes, (WINDOW_PX, WINDOW_PX), (SIGMA_PX, SIGMA_PX))[0].permute(1, 2, 0)


def _without_border(image: Tensor) -> Tensor:
    return image[BORDER_PX:-BORDER_PX, BORDER_PX:-BORDER_PX]


def lpips(
    rgb: Float[Tensor, "H W 3"],
    reference: Float[Tensor, "H W 3"],
) -> float | NotComputed:
    """Learned perceptual distance with AlexNet features; 0 for equal images, lower is better.

    Images are given to the network as RGB in -1..1, as it was trained.

    Returns:
        The distance, or the reason why there is none: the optional package ``lpips`` or AlexNet's
        weights are missing. Nothing is downloaded.

    Differentiable: no. Source: Zhang et al. 2018, linear weights of release 0.1.
    """
    a, b = _prepared(rgb, reference)
    return _network_distance(a * 2 - 1, b * 2 - 1)


def lpips_as_released(
    rgb: Float[Tensor, "H W 3"], reference: Float[Tensor, "H W 3"]
) -> float | NotComputed:
    """LPIPS as in GSFusion's published tables: the same network, given BGR in 0..1 instead of RGB
    in -1..1.

    The released evaluation reads images with OpenCV, which gives BGR, and leaves them in 0..1,
    where the network expects -1..1. Its numbers cannot be compared with LPIPS of other papers, nor
    with ``lpips``. Use it only beside published numbers. Arguments and result are those of
    ``lpips``.

    Differentiable: no. Source: GSFusion's released evaluation.
    """
    a, b = _prepared(rgb, reference)
    return _network_distance(a.flip(-1), b.flip(-1))


def _network_distance(
    a: Float[Tensor, "H W 3"],
    b: Float[Tensor, "H W 3"],
) -> float | NotComputed:
    network = _lpips_network()
    if isinstance(network, NotComputed):
        return network
    a, b = (image.permute(2, 0, 1)[None].float().cpu() for image in (a, b))
    with torch.no_grad():
        return float(network(a, b))


def lpips_unavailable() -> NotComputed | None:
    """The reason why LPIPS cannot be computed on this machine, or None. Fast; nothing is
    downloaded."""
    network = _lpips_network()
    return network if isinstance(network, NotComputed) else None


@functools.cache
def _lpips_network():
    try:
        import lpips as package  # pyright: ignore[reportMissingImports]
        from torchvision.models import AlexNet_Weights  # pyright: ignore[reportMissingImports]
    except ImportError as e:
        return NotComputed(
            f"package {e.name!r} is not installed (pip install 'gsfusion-nb[lpips]')"
        )
    except (
        RuntimeError
    ) as e:  # a torchvision for another version of torch fails while it registers its operators
        return NotComputed(f"torchvision is not compatible with the installed torch ({e})")
    name = AlexNet_Weights.IMAGENET1K_V1.url.rsplit("/", 1)[-1]
    weights = Path(torch.hub.get_dir()) / "checkpoints" / name
    if not weights.is_file():  # otherwise the package would start a download
        return NotComputed(f"AlexNet's weights are not on this machine (expected {weights})")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the package calls torchvision by a deprecated keyword
        return package.LPIPS(net="alex", verbose=False).eval()


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
    return (_mean(error) if len(error) else math.nan), share


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
    prepared = _prepared(*images)
    side = min(frame.rgb.shape[:2])
    l1_m, _ = depth_l1_m(expected_depth_m(view), frame.depth_m)
    similarity = _ssim_map(*prepared) if side >= 6 else torch.full((1, 1, 3), math.nan)
    not_requested = NotComputed("not requested")
    return ViewScores(
        index=frame.index,
        psnr=_psnr(*prepared),
        ssim=_mean(similarity),
        lpips=lpips(*images) if with_lpips else not_requested,
        ssim_as_released=_mean(_without_border(similarity)) if side > 2 * BORDER_PX else math.nan,
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
