"""What a seeding rule does after gradient steps: the statistics that it asks for, and its edits of the map."""

import dataclasses
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from ..errors import shown
from ..gaussians import Edit, GaussianModel
from ..optim import Keyframe, TrainingView
from ..render import Footprints, footprints
from ..seeding import ChangedInputError, MapRule, SeedContext, StepStats, check_memory, copy_memory, rule_name
from ..seeding.apply import Versions
from ..seeding.map_rule import check_needs
from ..seeding.points import add_up
from ..types import Camera, Frame
from .rule import RuleInUse


@dataclass(frozen=True, kw_only=True, eq=False)
class WatchedStep:
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


class AfterSteps:
    """Collects the statistics of gradient steps that a rule asks for, and lets it edit the map after them.

    Args:
        rule: The rule of the mapper; a function neither asks for statistics nor edits.
    """

    def __init__(self, rule: RuleInUse):
        made = rule.map_rule
        self._rule, self._name, self._running = made, rule_name(rule.rule), rule.running
        self._needs: frozenset[str] = frozenset() if made is None else made.statistics()
        check_needs(self._needs, f"seeding rule {self._name!r}: statistics()")
        self.edits = made is not None and type(made).after_step is not MapRule.after_step
        """Whether the rule may edit the map after a step."""
        self.is_used = self.edits or bool(self._needs)
        """Whether anything at all is done after a step."""
        self.taken = 0
        """Number of gradient steps so far; counted only if ``is_used``."""
        self._context: SeedContext | None = None
        self._steps_in_frame, self._first = 1, 0

    def frame_begins(self, context: SeedContext, n_steps: int) -> None:
        """The frame of ``context`` will be optimised with ``n_steps`` gradient steps."""
        self._context, self._steps_in_frame, self._first = context, n_steps, self.taken

    def frame_ends(self) -> None:
        """Further steps belong to the passes after the scan."""
        self._context = None

    def watch(
        self, model: GaussianModel, view: Frame | Keyframe | TrainingView, n_rows: int | None = None
    ) -> WatchedStep:
        """Begin a step; nothing is collected of it unless the rule asks for it.

        Args:
            model: The map before the step.
            view: What is rendered.
            n_rows: Number of rows that are rendered; all by default.
        """
        if not self.is_used:
            return WatchedStep()
        seen = footprints(model.params, view.camera, view.T_WC) if self._needs - {"render"} else None
        n = len(model) if n_rows is None else n_rows
        asked = [name in self._needs for name in ("image_gradients", "abs_image_gradients")]
        v_uv, v_uv_abs = (torch.zeros(n, 2, device=model.device) if wanted else None for wanted in asked)
        return WatchedStep(footprints=seen, v_uv=v_uv, v_uv_abs=v_uv_abs)

    def add_up(
        self, model: GaussianModel, step: WatchedStep, camera: Camera, rows: Int[Tensor, " R"] | None = None
    ) -> WatchedStep:
        """Count a step and add it to the statistics of each row; returns it with gradients for all rows of the map.

        Args:
            model: The map.
            step: From ``watch``.
            camera: That of the view.
            rows: Row of the map of each rendered Gaussian, if not all were.
        """
        self.taken += self.is_used
        seen = step.footprints
        if seen is None:
            return step
        if rows is not None:
            v_uv, v_uv_abs = (_spread(values, rows, len(model)) for values in (step.v_uv, step.v_uv_abs))
            step = WatchedStep(footprints=seen, v_uv=v_uv, v_uv_abs=v_uv_abs)
        add_up(model, seen.visible, step.v_uv, camera, step.v_uv_abs)
        return step

    def finish(
        self,
        mapper: Any,
        step: WatchedStep,
        view: Frame | Keyframe,
        loss: Float[Tensor, ""],
        rgb: Float[Tensor, "H W 3"],
    ) -> None:
        """``add_up`` of a step on all rows, then ``edit``; arguments as for these."""
        self.edit(mapper, self.add_up(mapper.gaussians, step, view.camera), view, loss, rgb)

    def edit(
        self,
        mapper: Any,
        step: WatchedStep,
        view: Frame | Keyframe,
        loss: Float[Tensor, ""],
        rgb: Float[Tensor, "H W 3"],
    ) -> None:
        """Let the rule edit the map, after a step was written to it.

        Args:
            mapper: The ``Mapper``, for its map, and its contexts of keyframes in the passes after the scan.
            step: From ``add_up``.
            view: What was rendered.
            loss: Loss before the step.
            rgb: The rendered picture.

        Raises:
            Exception: what the rule raises, or ``ValueError`` if its edit is not possible. The map has no part of the
                edit. In the passes after the scan the rule's memory and its random numbers are as before the call;
                online, whoever undoes the frame restores them.
        """
        if not self.edits:
            return
        if self._context is not None:
            self._edit(mapper, dataclasses.replace(self._context), self._stats(step, view, loss, rgb))
            return
        ctx = mapper.seed_context(_as_frame(view))
        memory, random_numbers = copy_memory(ctx.memory), ctx.generator.get_state()
        try:
            self._edit(mapper, ctx, self._stats(step, view, loss, rgb))
        except BaseException:
            ctx.memory.clear()
            ctx.memory.update(memory)
            ctx.generator.set_state(random_numbers)
            raise

    def _stats(self, step: WatchedStep, view: Frame | Keyframe, loss: Tensor, rgb: Tensor) -> StepStats:
        online, seen = self._context is not None, step.footprints
        return StepStats(
            step=self.taken,
            stage="online" if online else "passes",
            step_in_frame=self.taken - self._first if online else 1,
            steps_in_frame=self._steps_in_frame if online else 1,
            frame_index=view.index,
            camera=view.camera,
            T_WC=view.T_WC,
            target=view.rgb,
            loss=loss,
            rgb=rgb if "render" in self._needs else None,
            visible=None if seen is None else seen.visible,
            radius_px=None if seen is None else seen.radius_px,
            v_uv=step.v_uv,
            v_uv_abs=step.v_uv_abs,
        )

    def _edit(self, mapper: Any, ctx: SeedContext, stats: StepStats) -> None:
        assert self._rule is not None
        versions = Versions(ctx)
        with self._running():
            edit = self._rule.after_step(ctx, stats, ctx.memory)
        check_memory(self._name, ctx.memory)
        if changed := versions.changed():
            raise ChangedInputError(self._name, changed)
        if edit is None:
            return
        if not isinstance(edit, Edit):
            raise TypeError(f"seeding rule {self._name!r}: after_step must return an Edit or None, got {shown(edit)}")
        try:
            before = mapper.gaussians.edit(edit, ctx.generator, ctx.frame.index)
        except ValueError as error:
            raise ValueError(f"seeding rule {self._name!r} returned an impossible edit: {error}") from None
        mapper.rows_changed(before)


def _spread(values: Float[Tensor, "R 2"] | None, rows: Int[Tensor, " R"], n: int) -> Float[Tensor, "N 2"] | None:
    """Values of some rows, zero for the other rows of the ``n``."""
    return None if values is None else values.new_zeros(n, 2).index_copy_(0, rows, values)


def _as_frame(view: Frame | Keyframe) -> Frame:
    """A keyframe as a frame: at time 0, and without depth if it has none."""
    if isinstance(view, Frame):
        return view
    size, depth_m = view.rgb_u8.shape[:2], view.depth_m
    depth_m = torch.zeros(size, device=view.rgb_u8.device) if depth_m is None else depth_m
    return Frame(
        index=view.index, timestamp_s=0.0, colour=view.rgb_u8, depth_m=depth_m, camera=view.camera, T_WC=view.T_WC
    )
