"""What a mapping system says of itself: to reports, to live panels, to the command line."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any

from .step_report import StepReport

CURVES: Mapping[str, Callable[[StepReport], float | int]] = MappingProxyType(
    {
        "PSNR of the frame, dB": lambda report: report.psnr_after_db,
        "Gaussians": lambda report: report.n_gaussians,
    }
)
"""What is plotted of every system while it maps: title -> value after a step."""


def follows_nothing(config: Any) -> str:
    """The fidelity of a system that has only one kind of settings."""
    return ""


@dataclass(frozen=True, kw_only=True)
class SystemDescription:
    """What is true of every map of a system; ``Mapper.description``."""

    title: str
    """Name of the system in reports and messages."""
    fidelities: tuple[str, ...] = ()
    """Values of ``fidelity`` of its preset (what to follow where paper and released code differ),
    the default first; may be empty."""
    fidelity_of: Callable[[Any], str] = follows_nothing
    """``fidelity_of(config)``: which of ``fidelities`` the settings follow, with exceptions, in
    words; "" if none."""
    gaussians_are_discs: bool = False
    """Whether the Gaussians are discs on the surface; then their distance to the true surface is
    scored, too."""
    panels: tuple[str, ...] = ("input", "render", "error", "new_gaussians")
    """Pictures of one step to show while mapping, by name; ``gsfusion_nb.viz.map_pictures.PANELS``
    draws them."""
    curves: Mapping[str, Callable[[StepReport], float | int]] = field(
        default_factory=lambda: CURVES
    )
    """Title -> value after a step, plotted while mapping; NaN leaves a gap."""
    states: tuple[str, ...] = ()
    """Names of those counts of a step that add up to its Gaussians, if each is in a state; reports
    plot them."""
    needs_depth: bool = False
    """Whether a frame without any depth is refused."""
    needs_volume_to_render: bool = False
    """Whether the picture needs more than the Gaussians: then ``gaussians.ply`` alone does not show
    the map, and the system has its own ``MapFiles``."""
    memory_savers: tuple[str, ...] = ()
    """Settings, besides smaller images, that reduce the memory of the map; named in the message
    when memory is full."""
