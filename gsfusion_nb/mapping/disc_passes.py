"""The passes of RTG-SLAM over all keyframes after the scan, on all discs."""

from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from ..gaussians import STABLE
from ..large_maps import MapParts
from ..optim import Keyframe, TrainingView
from ..render.near_plane import near_plane_m
from ..types import ALL_ROWS, GaussianParams, MapRows
from .disc_optimisation import edit_after, step_on
from .parts_of_map import depth_behind_views
from .surfel_optimiser import SurfelOptimiser
from .transaction import Undo


class DiscPasses:
    """One optimiser of all discs, which all become stable at its first step.

    Args:
        mapper: The ``RTGSLAM``.
    """

    def __init__(self, mapper: Any):
        self._mapper = mapper
        self.optimiser: SurfelOptimiser | None = None
        """None before the first step, and when the map has other rows."""

    def step(self, keyframe: Keyframe) -> Float[Tensor, ""]:
        """One step on a keyframe, on all its pixels. Returns the loss before it."""
        mapper = self._mapper
        if self.optimiser is None:
            mapper.gaussians.undo_log.will_change()
            mapper.gaussians.state.fill_(STABLE)
            self.optimiser = self.optimiser_of_map()
        step = step_on(mapper, self.optimiser, keyframe, TrainingView.of(keyframe))
        self.optimiser.write_back()
        mapper.lost.stepped(self.optimiser.trained_params)
        edit_after(mapper, step)
        return step.view_step.loss

    def forget(self) -> None:
        """The next step begins with a new optimiser."""
        self.optimiser = None

    def snapshot(self) -> Undo:
        """A function that undoes what changes from now on."""
        optimiser = self.optimiser
        undo_steps = None if optimiser is None else optimiser.copies.undo_log.begin()

        def undo() -> None:
            self.optimiser = optimiser
            if optimiser is not None and undo_steps is not None:
                undo_steps()
                optimiser.copies.undo_log.end()

        return undo

    def end_log(self) -> None:
        """What changes from now on cannot be undone."""
        if self.optimiser is not None:
            self.optimiser.copies.undo_log.end()

    def state_dict(self) -> dict[str, Any] | None:
        """The state of the optimiser, if there is one."""
        return None if self.optimiser is None else self.optimiser.state_dict()

    def load_state_dict(self, state: dict[str, Any] | None) -> None:
        """Restore what ``state_dict`` saved, for the same map."""
        if state is not None:
            self.optimiser = self.optimiser_of_map()
            self.optimiser.load_state_dict(state)

    def optimiser_of_map(self) -> SurfelOptimiser:
        """A new optimiser of all discs."""
        mapper = self._mapper
        config = mapper.config.final
        return SurfelOptimiser(
            mapper.gaussians,
            torch.ones_like(mapper.gaussians.is_stable),
            mapper.config.window,
            mapper.config.discs,
            lr_factor=config.lr_factor,
            move_centres=False,
            all_in_view=mapper.config.all_in_view,
            training=mapper.training,
            weight_depth=config.weight_depth,
            near_m=near_plane_m(mapper.config),
        )


class DiscParts(MapParts):
    """The rows of RTG-SLAM's map that a view may show. Rows miss steps in the passes after the scan
    only, whose optimiser knows them.

    Args:
        mapper: The ``RTGSLAM``.
    """

    def __init__(self, mapper: Any):
        super().__init__(mapper.gaussians, None, depth_behind_views(mapper.config))
        self._discs = mapper.gaussians
        self._passes = mapper.disc_passes

    def params_now(self, rows: MapRows = ALL_ROWS) -> GaussianParams:
        """Discs of the map with the steps that they missed."""
        optimiser = self._passes.optimiser
        return self._discs.params[rows] if optimiser is None else optimiser.params_now(rows)

    def take_missed_steps(self) -> None:
        """Bring all discs up to date."""
        optimiser = self._passes.optimiser
        if optimiser is not None:
            optimiser.take_missed_steps()
            optimiser.write_back()

    def rows_changed(self, old_rows: Int[Tensor, " N"]) -> None:
        """All rows stay stable, and Adam goes on with those that are left."""
        earlier = self._passes.optimiser
        if earlier is not None:
            self._discs.state.fill_(STABLE)
            self._passes.optimiser = self._passes.optimiser_of_map()
            self._passes.optimiser.take_over(earlier, old_rows)
