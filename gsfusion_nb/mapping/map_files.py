"""The map of a system as files hold it: what is written, hashed, drawn from a folder and given to
other programs."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from jaxtyping import Float
from torch import Tensor

from ..errors import ArgumentError
from ..optim import fit_pose
from ..render import render
from ..render.near_plane import near_plane_m
from ..seeding import Cells
from ..tracking import SurfaceSource
from ..types import Camera, Frame, GaussianParams, Mesh, RenderOutput
from .tracking_surface import surface_of_picture
from .usual_torch import in_usual_torch

Draw = Callable[[Camera, Tensor], RenderOutput]
"""Renders a map for a camera and its camera-to-world pose."""


class MapFiles:
    """Files and pictures of a map, for runs, scores, exports and viewers; ``Mapper.files``.

    What belongs to a system and not to one map is a class method: a finished run is drawn from its
    folder, without a mapper. These defaults are for a map that its Gaussians alone show.

    Args:
        mapper: The ``Mapper`` whose map it is.
    """

    def __init__(self, mapper: Any):
        self.mapper = mapper

    @in_usual_torch
    def begin_with(self, params: GaussianParams, name: str = "another map") -> None:
        """Put Gaussians that were optimised elsewhere into the map before the first frame; they are
        optimised further.

        They must be in the world frame of the poses, in metres. The volume stays empty: the surface
        comes from the frames. A seeding rule sees them like its own.

        Args:
            params: The Gaussians.
            name: Of the file, for the notes of the run.

        Raises:
            ValueError: a frame was mapped before, a number is not finite, or the system cannot use
                them.
        """
        mapper = self.mapper
        if mapper.n_frames:
            raise ArgumentError(
                "a map can only begin with other Gaussians before its first frame; "
                f"{mapper.n_frames} are mapped"
            )
        mapper.gaussians.extend(params)
        mapper.notes.append(f"the map began with {len(params):,} Gaussians of {name}")

    def maps(self) -> dict[str, dict[str, Tensor]]:
        """The tensors of each map, by name; two runs have the same maps if these are equal
        (``order_of_rows``)."""
        return {"gaussians": vars(self.mapper.parts.params_now())}

    def order_of_rows(self, name: str) -> Tensor | None:
        """Order in which the rows of a map of ``maps`` are compared; None: as they are."""
        return None

    def constant_tensors(self) -> list[Tensor]:
        """Tensors in ``Mapper.state_dict`` that never change: a checkpoint writes them once."""
        images = [
            image
            for k in self.mapper.keyframes
            for image in (k.rgb_u8, k.depth_m, *k.extra.values())
        ]
        return [image for image in images if image is not None]

    def quadtree_cells(self, frame: Frame) -> Cells | None:
        """The quadtree cells of the frame that seeding used; ``None`` if the system has no
        quadtree."""
        return None

    def write_besides(self, folder: Path) -> None:
        """Write the files that the pictures need besides ``gaussians.ply``."""

    def stored_volume(self, folder: Path) -> dict[str, Any]:
        """State of the volume in the folder of a run, for a system that has one (``_load`` takes
        it)."""
        raise NotImplementedError

    def drawn_as_stored(self) -> Draw:
        """The map as its files hold it, which is what a run scores; made now, so not changed by
        later frames."""
        return self.mapper.render

    def forget_drawn(self) -> None:
        """Give back the memory that ``drawn_as_stored`` keeps to draw the same views again."""

    def standard_gaussians(self, mesh: Mesh | None = None) -> GaussianParams:
        """Gaussians whose sorted picture, as any viewer of splats draws it, is about that of the
        map.

        Args:
            mesh: The map's mesh, if it is at hand: a system that draws a surface saves the time to
                make it.
        """
        return self.mapper.parts.params_now()

    @classmethod
    def render_gaussians(
        cls, params: GaussianParams, camera: Camera, T_WC: Float[Tensor, "4 4"], config: Any
    ) -> RenderOutput:
        """Gaussians as this system renders and scores them. Default: blended colour and depth
        (Kerbl et al. 2023).

        Args:
            params: The Gaussians, of a mapper or read from a file.
            camera, T_WC: The camera and its pose.
            config: Settings of the system.
        """
        return render(params, camera, T_WC, near_m=near_plane_m(config))

    @classmethod
    def drawn_from(cls, folder: Path, params: GaussianParams, config: Any) -> Draw:
        """The map of a finished run, drawn from its folder. Here its Gaussians are all of it.

        Args:
            folder: Of the run, for systems whose pictures need its other files.
            params: Its Gaussians, on the device to draw on.
            config: Settings of the run.

        Raises:
            FileNotFoundError, ValueError: a file that the pictures need is missing or damaged.
        """
        device = params.xyz_W.device
        return lambda camera, T_WC: cls.render_gaussians(params, camera, T_WC.to(device), config)

    @classmethod
    def surface_from(cls, folder: Path, params: GaussianParams, config: Any) -> SurfaceSource:
        """The surface of the map of a finished run, from its folder, to which frames are aligned.
        Here it is what the picture of its Gaussians shows.

        Args:
            folder, params, config: As for ``drawn_from``.

        Raises:
            FileNotFoundError, ValueError: a file that the surface needs is missing or damaged.
        """
        draw = cls.drawn_from(folder, params, config)
        return lambda camera, T_WC: surface_of_picture(draw(camera, T_WC), camera, T_WC)

    @classmethod
    def aligned_pose(
        cls,
        draw: Draw,
        params: GaussianParams,
        frame: Frame,
        config: Any,
    ) -> Float[Tensor, "4 4"]:
        """The pose at which the map's picture fits the frame best; default: by the Gaussians alone
        (``fit_pose``)."""
        rgb = frame.rgb.to(params.xyz_W.device)
        near_m = near_plane_m(config)
        return fit_pose(params, frame.camera, rgb, frame.T_WC, near_m=near_m).T_WC

    @classmethod
    def standard_from(
        cls, folder: Path, params: GaussianParams, config: Any, poses: Sequence[Tensor], steps: int
    ) -> GaussianParams:
        """``standard_gaussians`` of a finished run, fitted to pictures of its map if they are not
        the map itself.

        Args:
            folder, params, config: As for ``drawn_from``.
            poses: Camera-to-world poses to see the map from. [4, 4] each
            steps: Gradient steps of the fit.
        """
        return params
