"""What a seeding rule sees of the gradient steps of a mapper, and its edits of the map after
them."""

import dataclasses
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ..checks import shown
from ..errors import ArgumentError, KindError
from ..gaussians import Edit, GaussianModel
from ..optim import Keyframe, TrainingView, ViewStep
from ..render import Footprints, footprints
from ..seeding import MapRule, SeedContext, StepStats, check_memory, copy_memory
from ..seeding.input_guard import unchanged_inputs
from ..seeding.map_rule import check_needs, rule_name
from ..seeding.points import add_up
from ..types import ALL_ROWS, Camera, Frame, MapRows
from .lost_rows import remove_lost
from .rule_in_use import RuleInUse


@dataclass(frozen=True, kw_only=True, eq=False)
class StepStatistics:
    """What is collected while a step is taken."""

    footprints: Footprints | None = None
    """Of all rows of the map."""
    v_uv: Float[Tensor, "N 2"] | None = None
    """To be filled by ``render_vjp``, one row for each Gaussian that it is given."""
    v_uv_abs: Float[Tensor, "N 2"] | None = None
    """Likewise."""

    @property
    def outputs(self) -> dict[str, Tensor | None]:
        """What ``render_vjp`` is asked to fill, by the name of its argument."""
        return {"v_uv": self.v_uv, "v_uv_abs": self.v_uv_abs}

    def of_rows(self, stays: Bool[Tensor, " N"]) -> "StepStatistics":
        """Those of the rows that stay in the map."""
        in_view = self.footprints
        if in_view is not None:
            in_view = Footprints(visible=in_view.visible[stays], radius_px=in_view.radius_px[stays])
        v_uv, v_uv_abs = (
            None if values is None else values[stays] for values in (self.v_uv, self.v_uv_abs)
        )
        return StepStatistics(footprints=in_view, v_uv=v_uv, v_uv_abs=v_uv_abs)


class AfterSteps:
    """Collects the statistics of gradient steps that a rule asks for, and lets it edit the map
    after them.

    Args:
        rule: The rule of the mapper; a function neither asks for statistics nor edits.
        near_m: Nearer Gaussians are not drawn, metres.
    """

    def __init__(self, rule: RuleInUse, near_m: float):
        self._near_m = near_m
        map_rule = rule.map_rule
        self._rule_in_use = rule
        self._rule = map_rule
        self._name = rule_name(rule.rule)
        self._needs: frozenset[str] = frozenset() if map_rule is None else map_rule.statistics()
        check_needs(self._needs, f"seeding rule {self._name!r}: statistics()")
        self.edits = map_rule is not None and type(map_rule).after_step is not MapRule.after_step
        """Whether the rule may edit the map after a step."""
        self.is_used = self.edits or bool(self._needs)
        """Whether anything at all is done after a step."""
        self.n_steps = 0
        """Number of gradient steps so far; counted only if ``is_used``."""
        self._context: SeedContext | None = None
        self._steps_in_frame = 1
        self._first_step = 0

    def frame_begins(self, context: SeedContext, n_steps: int) -> None:
        """The frame of ``context`` will be optimised with ``n_steps`` gradient steps."""
        self._context = context
        self._steps_in_frame = n_steps
        self._first_step = self.n_steps

    def frame_ends(self) -> None:
        """Further steps belong to the passes after the scan."""
        self._context = None

    def watch(
        self, model: GaussianModel, view: Frame | Keyframe | TrainingView, n_rows: int | None = None
    ) -> StepStatistics:
        """Begin a step; nothing is collected of it unless the rule asks for it.

        Args:
            model: The map before the step.
            view: What is rendered.
            n_rows: Number of rows that are rendered; all by default.
        """
        if not self.is_used:
            return StepStatistics()
        n = len(model) if n_rows is None else n_rows
        v_uv, v_uv_abs = (
            torch.zeros(n, 2, device=model.device) if name in self._needs else None
            for name in ("image_gradients", "abs_image_gradients")
        )
        in_view = self._needs - {"render"}
        return StepStatistics(
            footprints=footprints(model.params, view.camera, view.T_WC, self._near_m)
            if in_view
            else None,
            v_uv=v_uv,
            v_uv_abs=v_uv_abs,
        )

    def add_up(
        self,
        model: GaussianModel,
        step: StepStatistics,
        camera: Camera,
        rows: MapRows = ALL_ROWS,
    ) -> StepStatistics:
        """Count a step and add it to the statistics of each row; returns it with gradients for all
        rows of the map.

        Args:
            model: The map.
            step: From ``watch``.
            camera: That of the view.
            rows: The rows of the map that were rendered.
        """
        self.n_steps += self.is_used
        in_view = step.footprints
        if in_view is None:
            return step
        if isinstance(rows, Tensor):
            v_uv, v_uv_abs = (
                _of_all_rows(values, rows, len(model)) for values in (step.v_uv, step.v_uv_abs)
            )
            step = StepStatistics(footprints=in_view, v_uv=v_uv, v_uv_abs=v_uv_abs)
        add_up(model, in_view.visible, step.v_uv, camera, step.v_uv_abs)
        return step

    def edit(
        self,
        mapper: Any,
        step: StepStatistics,
        view: Frame | Keyframe,
        view_step: ViewStep,
        target_rgb: Float[Tensor, "H W 3"],
    ) -> None:
        """Let the rule edit the map, after a step was written to it.

        Args:
            mapper: The ``Mapper``, for its map, and its contexts of keyframes in the passes after
                the scan.
            step: From ``add_up``.
            view: What was rendered.
            view_step: Loss and picture before the step.
            target_rgb: The image of the view.

        Raises:
            Exception: what the rule raises, or ``ValueError`` if its edit is not possible. The map
                has no part of the edit. In the passes after the scan the rule's memory and its
                random numbers are as before the call; online, whoever undoes the frame restores
                them.
        """
        if not self.edits:
            return
        mapper.parts.take_missed_steps()  # an edit reads, copies and removes any row
        stays = remove_lost(mapper)  # the rule would remove what is NaN, and nobody would know
        if stays is not None:
            step = step.of_rows(stays)
        stats = self._stats(step, view, view_step, target_rgb)
        if self._context is not None:
            self._edit(mapper, dataclasses.replace(self._context), stats)
            return
        ctx = mapper.seed_context(_as_frame(view))
        memory = copy_memory(ctx.memory)
        random_numbers = ctx.generator.get_state()
        try:
            self._edit(mapper, ctx, stats)
        except BaseException:
            ctx.memory.clear()
            ctx.memory.update(memory)
            ctx.generator.set_state(random_numbers)
            raise

    def _stats(
        self,
        step: StepStatistics,
        view: Frame | Keyframe,
        view_step: ViewStep,
        target_rgb: Float[Tensor, "H W 3"],
    ) -> StepStats:
        online = self._context is not None
        in_view = step.footprints
        return StepStats(
            step=self.n_steps,
            stage="online" if online else "passes",
            step_in_frame=self.n_steps - self._first_step if online else 1,
            steps_in_frame=self._steps_in_frame if online else 1,
            frame_index=view.index,
            camera=view.camera,
            T_WC=view.T_WC,
            target=target_rgb,
            loss=view_step.loss,
            rgb=view_step.rgb if "render" in self._needs else None,
            visible=None if in_view is None else in_view.visible,
            radius_px=None if in_view is None else in_view.radius_px,
            v_uv=step.v_uv,
            v_uv_abs=step.v_uv_abs,
        )

    def _edit(self, mapper: Any, ctx: SeedContext, stats: StepStats) -> None:
        assert self._rule is not None
        with (
            self._rule_in_use.call_context(),
            unchanged_inputs(ctx, self._rule_in_use.bound, is_quick=True),
        ):
            edit = self._rule.after_step(ctx, stats, ctx.memory)
        check_memory(self._name, ctx.memory)
        if edit is None:
            return
        if not isinstance(edit, Edit):
            raise KindError(
                f"seeding rule {self._name!r}: after_step must return an Edit or None, got "
                f"{shown(edit)}"
            )
        try:
            old_rows = mapper.gaussians.edit(edit, ctx.generator, ctx.frame.index)
        except ValueError as error:
            raise ArgumentError(
                f"seeding rule {self._name!r} returned an impossible edit: {error}"
            ) from None
        mapper.parts.rows_changed(old_rows)


def _of_all_rows(
    values: Float[Tensor, "R 2"] | None, rows: Int[Tensor, " R"], n: int
) -> Float[Tensor, "N 2"] | None:
    """Values of some rows, zero for the other rows of the ``n``."""
    return None if values is None else values.new_zeros(n, 2).index_copy_(0, rows, values)


def _as_frame(view: Frame | Keyframe) -> Frame:
    """A keyframe as a frame: at time 0, and without depth if it has none."""
    if isinstance(view, Frame):
        return view
    size = view.rgb_u8.shape[:2]
    depth_m = view.depth_m
    depth_m = torch.zeros(size, device=view.rgb_u8.device) if depth_m is None else depth_m
    return Frame(
        index=view.index,
        timestamp_s=0.0,
        colour=view.rgb_u8,
        depth_m=depth_m,
        camera=view.camera,
        T_WC=view.T_WC,
    )
