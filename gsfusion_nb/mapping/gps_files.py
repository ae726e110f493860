"""GPS-SLAM's map in files: Gaussians drawn over a TSDF, which plain viewers get as discs."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from jaxtyping import Float
from torch import Tensor

from ..optim import fit_pose_by_flow
from ..render.near_plane import near_plane_m
from ..types import Frame, GaussianParams, Mesh
from .gps_surface import OverSurface, StoredLooks, fit_to_pictures, plain_gaussians
from .map_files import Draw
from .tsdf_mapping import TsdfFiles
from .usual_torch import in_usual_torch


class GpsFiles(TsdfFiles):
    """Files and pictures of a map whose picture needs its TSDF."""

    def __init__(self, mapper: Any):
        super().__init__(mapper)
        self.stored_looks = StoredLooks()
        """What was seen of the surface as its file holds it."""
        self._discs: tuple[int, GaussianParams | None] = (0, None)
        """Number of frames when the surface was made discs last, and these."""

    def constant_tensors(self) -> list[Tensor]:
        """Images of keyframes and of the views."""
        return [*super().constant_tensors(), *self.mapper.views.constant_tensors()]

    def drawn_as_stored(self) -> Draw:
        """The map with its TSDF rounded as in the file."""
        mapper = self.mapper
        over = OverSurface(
            volume=mapper.volume,
            params=mapper.parts.params_now(),
            config=mapper.config.base,
            look=self.stored_looks.of(mapper.volume, mapper.n_frames),
            near_m=near_plane_m(mapper.config),
        )
        return over.render

    def forget_drawn(self) -> None:
        """Give back the memory of what was seen of the surface."""
        self.stored_looks.forget()

    @in_usual_torch
    def standard_gaussians(self, mesh: Mesh | None = None) -> GaussianParams:
        """The Gaussians in front of the surface, then the surface as discs.

        While a map grows, the discs are made anew only when a tenth more frames were mapped.
        """
        mapper = self.mapper
        n_frames, discs = self._discs
        if mapper.n_frames > n_frames + n_frames // 10:
            n_frames = mapper.n_frames
            discs = None
        rows = plain_gaussians(mapper.volume, mapper.parts.params_now(), discs, mesh)
        self._discs = n_frames, rows[len(mapper.gaussians) :]
        return rows

    def forget_discs(self) -> None:
        """Make the discs anew when they are asked for, because the surface is another one."""
        self._discs = (0, None)

    @classmethod
    def drawn_from(cls, folder: Path, params: GaussianParams, config: Any) -> Draw:
        """The map of a finished run, drawn from its folder."""
        return OverSurface.of_folder(folder, params, config).render

    @classmethod
    def aligned_pose(
        cls,
        draw: Draw,
        params: GaussianParams,
        frame: Frame,
        config: Any,
    ) -> Float[Tensor, "4 4"]:
        """The pose at which the whole picture fits the frame best; the surface moves in it, too."""
        rgb = frame.rgb.to(params.xyz_W.device)
        return fit_pose_by_flow(draw, frame.camera, rgb, frame.T_WC).T_WC

    @classmethod
    def standard_from(
        cls, folder: Path, params: GaussianParams, config: Any, poses: Sequence[Tensor], steps: int
    ) -> GaussianParams:
        """The surface as discs, and the Gaussians in front of it, fitted to pictures of the map."""
        over = OverSurface.of_folder(folder, params, config)
        rows = plain_gaussians(over.volume, params)
        return fit_to_pictures(rows, over.render, poses, steps) if poses and len(rows) else rows
