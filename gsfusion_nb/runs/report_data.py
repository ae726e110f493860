"""The data that the report page of a run shows."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from jaxtyping import Float
from torch import Tensor

from ..drawing.pictures import AnyImage
from ..evaluation.image import expected_depth_m, psnr, ssim
from ..types import Frame, RenderOutput


@dataclass(frozen=True, kw_only=True)
class FrameRow:
    """Numbers of one mapped frame."""

    index: int
    """Frame number in the source sequence."""
    seconds: float
    """Time of the whole step, seconds."""
    n_gaussians: int
    """Number of Gaussians in the map after the step."""
    n_seeds: int
    """New Gaussians of this step."""
    keyframe: bool
    psnr_before: float = float("nan")
    """PSNR of this view before the step's optimisation, dB; NaN if not measured."""
    psnr: float = float("nan")
    """PSNR of this view after it, dB."""
    losses: tuple[float, ...] = ()
    """Loss at each optimisation step."""
    stage_seconds: Mapping[str, float] = field(default_factory=dict)
    """Stage name -> seconds, in the order of the step."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ReportView:
    """One view: input image and render."""

    name: str
    """For example "Frame 60"."""
    held_out: bool
    """True if the view was never mapped."""
    rgb: Float[Tensor, "H W 3"]
    render: Float[Tensor, "H W 3"]
    depth_m: Float[Tensor, "H W"] | None = None
    """Measured depth, metres."""
    render_depth_m: Float[Tensor, "H W"] | None = None
    """Rendered depth, metres, 0 where the map covers nothing."""
    cells: Any = None
    """Quadtree cells of this frame (``x0, y0, width, height, level``), or None."""
    psnr: float = float("nan")
    """dB."""
    ssim: float = float("nan")

    @staticmethod
    def of(frame: Frame, view: RenderOutput, *, held_out: bool, cells: Any = None) -> "ReportView":
        """A frame and the render of its view, with their scores."""
        view = view.to(frame.rgb.device)
        return ReportView(
            name=f"Frame {frame.index}",
            held_out=held_out,
            rgb=frame.rgb,
            render=view.rgb,
            depth_m=frame.depth_m,
            render_depth_m=expected_depth_m(view),
            cells=cells,
            psnr=psnr(view.rgb, frame.rgb),
            ssim=ssim(view.rgb, frame.rgb) if min(frame.rgb.shape[:2]) >= 6 else float("nan"),
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class ReportData:
    """Everything the report shows. Only the title is required; parts that are not given are not shown."""

    title: str
    subtitle: str = ""
    """One line: data set, preset, date."""
    metrics: Mapping[str, Any] = field(default_factory=dict)
    """Name -> number or ``NotComputed``; the known names, labels and units are in ``metrics.METRIC_GROUPS``."""
    config: Mapping[str, Any] = field(default_factory=dict)
    """Settings as nested dictionaries, as from ``dataclasses.asdict``."""
    frames: Sequence[FrameRow] = ()
    global_losses: Sequence[float | int] = ()
    """Mean loss of each pass of the global optimisation."""
    views: Sequence[ReportView] = ()
    mesh_pictures: Mapping[str, AnyImage] = field(default_factory=dict)
    """Caption -> picture of the mesh."""
    warnings: Sequence[str] = ()
    """Sentences shown at the top, for example why a run ended early."""
    environment: Mapping[str, Any] = field(default_factory=dict)
    """Versions, threads, device."""
    files: Mapping[str, str] = field(default_factory=dict)
    """File name -> what it contains and which programs open it."""
