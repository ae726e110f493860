"""One view of a report: what the camera saw, and what the map shows there."""

from dataclasses import dataclass
from typing import Any

from jaxtyping import Float
from torch import Tensor

from ..evaluation.image import psnr, ssim
from ..evaluation.view_scores import expected_depth_m
from ..types import Frame, RenderOutput


@dataclass(frozen=True, kw_only=True, eq=False)
class ReportPanel:
    """One view: input image and render."""

    name: str
    """For example "Frame 60"."""
    held_out: bool
    """True if the view was never mapped."""
    rgb: Float[Tensor, "H W 3"]
    render: Float[Tensor, "H W 3"]
    depth_m: Float[Tensor, "H W"]
    """Measured depth, metres."""
    render_depth_m: Float[Tensor, "H W"]
    """Rendered depth, metres, 0 where the map covers nothing."""
    psnr: float
    """dB."""
    ssim: float
    cells: Any = None
    """Quadtree cells of this frame (``x0, y0, width, height, level``), or None."""
    T_WC: Float[Tensor, "4 4"] | None = None
    """Camera-to-world pose."""

    @staticmethod
    def of(
        frame: Frame,
        view: RenderOutput,
        *,
        held_out: bool,
        cells: Any = None,
    ) -> "ReportPanel":
        """A frame and the render of its view, with their scores."""
        view = view.to(frame.rgb.device)
        return ReportPanel(
            name=f"Frame {frame.index}",
            held_out=held_out,
            rgb=frame.rgb,
            render=view.rgb,
            depth_m=frame.depth_m,
            render_depth_m=expected_depth_m(view),
            cells=cells,
            T_WC=frame.T_WC.cpu(),
            psnr=psnr(view.rgb, frame.rgb),
            ssim=ssim(view.rgb, frame.rgb) if min(frame.rgb.shape[:2]) >= 6 else float("nan"),
        )
