"""A map of GPS-SLAM as a camera sees it: the TSDF's picture, and the Gaussians blended over it."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from jaxtyping import Float
from torch import Tensor

from ..config import BaseConfig
from ..export.tsdf_file import as_stored, read_tsdf, write_tsdf
from ..optim import fit_pose_by_flow
from ..render import BaseView, base_view, render_over_base
from ..tsdf import TsdfVolume, raycast
from ..types import Camera, Frame, GaussianParams, RenderOutput
from .baked import baked, fitted
from .stored_map import Draw, StoredMap

TSDF = "tsdf.npz"
"""The TSDF in a run's folder."""


@dataclass(frozen=True, kw_only=True, eq=False)
class OverSurface:
    """A surface and the Gaussians that correct its picture."""

    volume: TsdfVolume
    params: GaussianParams
    config: BaseConfig

    def below(self, camera: Camera, T_WC: Float[Tensor, "4 4"]) -> BaseView:
        """What a camera sees of the surface below the Gaussians, one ray for each pixel."""
        seen = raycast(self.volume, camera, T_WC.to(self.volume.device))
        return base_view(seen.rgb, seen.depth_m, (camera.height, camera.width), self.config.holes, self.config.behind_m)

    def render(self, camera: Camera, T_WC: Float[Tensor, "4 4"]) -> RenderOutput:
        """Surface and Gaussians seen by a camera; alpha is 1 where there is a surface, and depth is the surface's."""
        below = self.below(camera, T_WC)
        device = self.volume.device
        out, _ = render_over_base(self.params, camera, T_WC.to(device), below.base, behind_m=below.behind_m)
        return out.as_render_output(below.base)

    @staticmethod
    def of_folder(folder: Path, params: GaussianParams, config: Any) -> "OverSurface":
        """The map of a finished run; ``params`` are its Gaussians, ``config`` its settings."""
        volume = read_tsdf(folder / TSDF, config.tsdf, params.xyz_W.device)
        return OverSurface(volume=volume, params=params, config=config.base)


class StoredWithSurface(StoredMap):
    """The part of a mapper that draws over its TSDF, which the run's folder therefore keeps."""

    volume: TsdfVolume
    gaussians: Any
    n_frames: int
    config: Any
    _discs: tuple[int, GaussianParams | None] = (0, None)
    """Number of frames when discs were made last, and these."""

    def write_besides(self, folder: Path) -> None:
        """Write the TSDF."""
        write_tsdf(folder / TSDF, self.volume)

    def drawn_as_stored(self) -> Draw:
        """The map with its TSDF rounded as in the file."""
        return OverSurface(volume=as_stored(self.volume), params=self.gaussians.params, config=self.config.base).render

    @classmethod
    def drawn_from(cls, folder: Path, params: GaussianParams, config: Any) -> Draw:
        """The map of a finished run, drawn from its folder."""
        return OverSurface.of_folder(folder, params, config).render

    @classmethod
    def aligned_pose(cls, draw: Draw, params: GaussianParams, frame: Frame) -> Float[Tensor, "4 4"]:
        """The pose at which the whole picture fits the frame best; the surface moves in it, too."""
        return fit_pose_by_flow(draw, frame.camera, frame.rgb.to(params.xyz_W.device), frame.T_WC).T_WC

    def forget_discs(self) -> None:
        """Make discs anew next time, because the surface was made anew."""
        self._discs = (0, None)

    def standard_gaussians(self) -> GaussianParams:
        """The Gaussians in front of the surface, then the surface as discs.

        While a map grows, the discs are made anew only when a tenth more frames were mapped.
        """
        made, discs = self._discs
        n = len(self.gaussians)
        if self.n_frames > made + made // 10:
            made, discs = self.n_frames, None
        rows = baked(self.volume, self.gaussians.params, discs)
        self._discs = made, rows[n:]
        return rows

    @classmethod
    def standard_from(
        cls, folder: Path, params: GaussianParams, config: Any, poses: Sequence[Tensor], steps: int
    ) -> GaussianParams:
        """The surface as discs, and the Gaussians in front of it, fitted to pictures of the map."""
        over = OverSurface.of_folder(folder, params, config)
        rows = baked(over.volume, params)
        return fitted(rows, over.render, poses, steps) if poses and len(rows) else rows
