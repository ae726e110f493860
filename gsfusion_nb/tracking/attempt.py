"""One attempt of ICP: a frame prepared for it, a starting pose, and the pose that it leads to."""

import dataclasses
import time
from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from ..config import TrackingConfig
from ..types import Frame
from .brightness import Pictures, brightness_levels
from .icp import ExtraRows, IcpResult, align
from .pyramid import DepthLevel, depth_pyramid
from .surface import Surface, SurfaceSource, smooth_normals

WIDE_DISTANCE = 3.0
WIDE_ANGLE_DEG = 60.0
"""ICP from a wide start allows this many times the distance and normals at up to this angle: on the coarse levels it
finds a pose that the usual limits then refine."""


@dataclass(frozen=True, eq=False)
class Sight:
    """A frame prepared for ICP."""

    frame: Frame
    levels: list[DepthLevel]
    brightness: dict[int, Tensor]
    """Factor of each level -> brightness; empty if it is not used."""
    extra: ExtraRows | None = None
    """Further rows of its least squares."""

    @classmethod
    def of(cls, frame: Frame, config: TrackingConfig, extra: ExtraRows | None = None) -> "Sight":
        """The frame at all levels of the pyramid."""
        levels = depth_pyramid(frame.depth_m, frame.camera, config.pyramid)
        brightness = brightness_levels(frame.rgb, config.pyramid) if config.brightness_m else {}
        return cls(frame, levels, brightness, extra)

    @property
    def has_depth(self) -> bool:
        """Whether any pixel of the finest level is usable."""
        return bool((self.levels[-1].depth_m > 0).any())


@dataclass(frozen=True, eq=False)
class Start:
    """A starting pose of ICP."""

    name: str
    T_WC: Float[Tensor, "4 4"]
    wide: bool = False
    """Use wide limits of distance and angle first."""
    smooth: bool = False
    """Average the model's normals over their neighbours."""
    anywhere: bool = False
    """It may be far from the last pose."""


@dataclass(frozen=True, eq=False)
class Attempt:
    """What ICP made of a start."""

    start: Start
    surface: Surface
    """The surface that the frame was aligned with."""
    result: IcpResult


def attempt(
    sight: Sight, source: SurfaceSource, mixed: SurfaceSource, start: Start, config: TrackingConfig, clock: "Clocks"
) -> Attempt:
    """Align a frame from one start.

    Args:
        sight: The frame.
        source: Renders the model.
        mixed: Renders the target of the settings, which may be mixed with the last frame.
        start: Where to start; from a wide one the model alone is used.
        config: Pyramid levels, limits, damping.
        clock: Gets the time of "render" and "icp".
    """
    T_WC, camera = start.T_WC, sight.frame.camera
    if start.wide:
        with clock("render"):
            surface = source(camera, T_WC.float())
        with clock("icp"):
            T_WC = align(sight.levels[:-1] or sight.levels, surface, T_WC, _widened(config)).T_WC
    with clock("render"):
        surface = (source if start.wide else mixed)(camera, T_WC.float())
        if start.smooth:
            surface = smooth_normals(surface)
    with clock("icp"):
        pictures = Pictures.of(sight.brightness, surface) if sight.brightness else None
        return Attempt(start, surface, align(sight.levels, surface, T_WC, config, sight.extra, pictures))


def _widened(config: TrackingConfig) -> TrackingConfig:
    coarse = config.pyramid[:-1] or config.pyramid
    return dataclasses.replace(
        config,
        pyramid=coarse,
        iterations=tuple(4 * n for n in config.iterations[: len(coarse)]),
        max_distance_m=WIDE_DISTANCE * config.max_distance_m,
        max_angle_deg=max(WIDE_ANGLE_DEG, config.max_angle_deg),
    )


class Clocks:
    """Sums of wall-clock time: ``with clocks("render"): ...``."""

    def __init__(self, *parts: str):
        self.seconds = dict.fromkeys(parts, 0.0)

    def __call__(self, part: str) -> "Clocks":
        self._part = part
        return self

    def __enter__(self) -> None:
        self._start = time.perf_counter()

    def __exit__(self, *_: object) -> None:
        self.seconds[self._part] += time.perf_counter() - self._start
