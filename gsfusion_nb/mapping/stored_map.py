"""What a run's folder keeps so that its pictures can be drawn again, and how a view is fitted to them."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from jaxtyping import Float
from torch import Tensor

from ..optim import fit_pose
from ..types import Camera, Frame, GaussianParams, RenderOutput

Draw = Callable[[Camera, Tensor], RenderOutput]
"""Renders a map for a camera and its camera-to-world pose."""


class StoredMap:
    """The part of every mapper that says what besides ``gaussians.ply`` a folder must hold to show its map.

    Here: nothing. A system whose pictures need more overrides all but ``aligned_pose``, which it overrides if the
    picture moves otherwise than its Gaussians do. ``Mapper`` sets the attributes.
    """

    gaussians: Any

    render: Any
    render_gaussians: Any

    def write_besides(self, folder: Path) -> None:
        """Write the files that the pictures need besides ``gaussians.ply``."""

    def drawn_as_stored(self) -> Draw:
        """The map as its files hold it, which is what a run scores; made now, so not changed by later frames."""
        return self.render

    @classmethod
    def drawn_from(cls, folder: Path, params: GaussianParams, config: Any) -> Draw:
        """The map of a finished run, drawn from its folder.

        Args:
            folder: Of the run.
            params: Its Gaussians, on the device to draw on.
            config: Settings of the run.

        Raises:
            FileNotFoundError, ValueError: a file that the pictures need is missing or damaged.
        """
        device = params.xyz_W.device
        return lambda camera, T_WC: cls.render_gaussians(params, camera, T_WC.to(device), config)

    @classmethod
    def aligned_pose(cls, draw: Draw, params: GaussianParams, frame: Frame) -> Float[Tensor, "4 4"]:
        """The pose at which the map's picture fits the frame best; default: by the Gaussians alone (``fit_pose``)."""
        return fit_pose(params, frame.camera, frame.rgb.to(params.xyz_W.device), frame.T_WC).T_WC

    def standard_gaussians(self) -> GaussianParams:
        """Gaussians whose sorted picture, as any viewer of splats draws it, is about that of the map."""
        return self.gaussians.params

    @classmethod
    def standard_from(
        cls, folder: Path, params: GaussianParams, config: Any, poses: Sequence[Tensor], steps: int
    ) -> GaussianParams:
        """``standard_gaussians`` of a finished run, fitted to pictures of its map if they are not the map itself.

        Args:
            folder, params, config: As for ``drawn_from``.
            poses: Camera-to-world poses to see the map from. [4, 4] each
            steps: Gradient steps of the fit.
        """
        return params
