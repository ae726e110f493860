"""The optimisation of an RTG-SLAM map: windows of frames, keyframes, and the passes after the scan (Eq. 7-9)."""

import math
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ..config import RtgSlamConfig
from ..gaussians import STABLE, SurfelModel
from ..optim import Keyframe, TrainingView, fuse_with_history
from ..render import rows_in_view
from ..seeding import SeedContext
from ..types import Frame, GaussianParams
from .after_steps import WatchedStep
from .mapper import Mapper
from .surfel_optimiser import SurfelOptimiser

MASKED_BELOW = 0.8
"""If more of the rows in view are unstable, they touch nearly all pixels; finding these then saves no time."""

LastStep = tuple[int, Tensor, WatchedStep]
"""Number of its view, its loss, and what was collected of it."""


class SurfelMapping(Mapper):
    """What a mapper of discs does to optimise them; arguments as for ``Mapper``."""

    config: RtgSlamConfig
    gaussians: SurfelModel

    def __init__(self, *args: Any, **options: Any):
        super().__init__(*args, **options)
        self.window: deque[Frame] = deque(maxlen=self.config.window.frames)
        self._final: SurfelOptimiser | None = None

    def _window_is_due(self, is_keyframe: bool) -> bool:
        if not self.n_frames:
            return True
        replaced = is_keyframe and self.config.keyframes.instead_of_window and bool(self.gaussians.is_stable.any())
        return (self.n_frames + 1) % self.config.window.every_frames == 0 and not replaced

    def _begin(self, context: SeedContext, is_keyframe: bool, window: bool, keyframes: bool) -> None:
        """Take the frame of ``context`` into the window, and keep it if it is a keyframe. What will be optimised is
        told to ``after_steps``."""
        self._final = None  # its rows are no longer the map's
        self.window.append(context.frame)
        if is_keyframe:
            self.keyframes.append(context.frame, with_depth=True)
        n_steps = window * self.config.window.iterations + keyframes * self.config.keyframes.iterations
        self.after_steps.frame_begins(context, n_steps)

    def _optimise_window(self) -> list[float]:
        """Optimise the unstable Gaussians against the last frames, then fuse them with the old values (Eq. 7-9)."""
        config, model = self.config.window, self.gaussians
        trained = ~model.is_stable if config.only_unstable else torch.ones_like(model.is_stable)
        seen = self._seen(self.window)
        if not (trained & seen).any():
            return []
        optimiser = SurfelOptimiser(model, trained, config, self.config.discs, seen=seen, training=self.training)
        before = GaussianParams(**{name: value.clone() for name, value in vars(optimiser.trained).items()})
        masked = config.only_unstable and optimiser.n < MASKED_BELOW * int(seen.sum())
        touched = [optimiser.touched(f.camera, f.T_WC) if masked else None for f in self.window]
        views = [TrainingView.of(frame, pixels) for frame, pixels in zip(self.window, touched, strict=True)]
        newest_from = config.iterations / 2 if config.draw == "newest_half" else math.inf
        losses, last = self._take_steps(optimiser, views, config.iterations, newest_from)
        was = model.confidence[optimiser.rows]
        now = was + optimiser.steps_seen
        fused = fuse_with_history(
            before, optimiser.trained, was, now, history_max_weight=config.history_max_weight
        )  # Eq. 9
        optimiser.write_back(fused)
        model.confidence[optimiser.rows] = now
        self._edit(optimiser, self.window, last)
        return torch.stack(losses).tolist() if losses else []

    def _optimise_keyframes(self) -> int:
        """Optimise over the latest and some random keyframes, on the pixels with the largest colour errors.

        Returns the number of gradient steps.
        """
        config, model = self.config.keyframes, self.gaussians
        n = len(self.keyframes)
        latest = list(range(max(0, n - config.latest), n))
        earlier = torch.randperm(n - len(latest), generator=self.random.keyframes)[: config.random].tolist()
        chosen = [self.keyframes[i].to(self.device) for i in earlier + latest]
        rows = model.is_stable if config.rows == "stable" else torch.ones_like(model.is_stable)
        seen = self._seen(chosen)
        if not (rows & seen).any():
            return 0
        optimiser = SurfelOptimiser(
            model,
            rows,
            self.config.window,
            self.config.discs,
            drawn=rows,
            seen=seen,
            lr_factor=config.lr_factor,
            move_centres=False,
            training=self.training,
        )
        views = [TrainingView.of(keyframe, self._worst_pixels(keyframe)) for keyframe in chosen]
        _, last = self._take_steps(optimiser, views, config.iterations)
        optimiser.write_back()
        self._edit(optimiser, chosen, last)
        return config.iterations

    def _take_steps(
        self, optimiser: SurfelOptimiser, views: list[TrainingView], n: int, newest_from: float = math.inf
    ) -> tuple[list[Tensor], LastStep | None]:
        """``n`` gradient steps on views drawn at random, from step ``newest_from`` on only on the newest.

        Returns the losses before them; and the number of the view, the loss and what was collected of the last step,
        None if nothing is.
        """
        losses, last = [], None
        for step in range(n):
            self.guard.may_stop()
            i = len(views) - 1 if step >= newest_from else self._draw(len(views))
            loss, watched = self.after_steps.surfel_step(self.gaussians, optimiser, views[i])
            losses.append(loss)
            last = None if watched is None else (i, loss, watched)
        return losses, last

    def _edit(self, optimiser: SurfelOptimiser, sources: Sequence[Frame | Keyframe], last: LastStep | None) -> None:
        """Let the rule edit the map after its rows were written back."""
        if last is not None:
            i, loss, watched = last
            assert optimiser.picture is not None
            self.after_steps(self, watched, sources[i], loss, optimiser.picture)

    def _seen(self, views: Iterable[Frame | Keyframe]) -> Bool[Tensor, " N"]:
        """Rows that any of the views may show."""
        params, seen = self.gaussians.params, torch.zeros_like(self.gaussians.is_stable)
        for view in views:
            seen |= rows_in_view(params, view.camera, view.T_WC)
        return seen

    def _worst_pixels(self, keyframe: Keyframe) -> Bool[Tensor, "H W"]:
        """The pixels with the largest colour errors, a fixed share of the image."""
        view = self.surface(keyframe.camera, keyframe.T_WC)
        error = (view.rgb - keyframe.rgb).abs().mean(dim=-1)
        return error >= error.flatten().quantile(1 - self.config.keyframes.pixel_share)

    def _global_step(self, i: int) -> Float[Tensor, ""]:
        """One step on the i-th keyframe, on all pixels and all Gaussians, which all become stable at the first step."""
        if self._final is None:
            self.gaussians.state.fill_(STABLE)
            self._final = self._final_optimiser()
        keyframe = self.keyframes[i].to(self.device)
        loss, watched = self.after_steps.surfel_step(self.gaussians, self._final, TrainingView.of(keyframe))
        self._final.write_back()
        self._edit(self._final, [keyframe], None if watched is None else (0, loss, watched))
        return loss

    def rows_changed(self, before: Int[Tensor, " N"]) -> None:
        """In the passes after the scan all rows stay stable, and Adam goes on with the rows that are left."""
        if self._final is not None:
            self.gaussians.state.fill_(STABLE)
            earlier, self._final = self._final, self._final_optimiser()
            self._final.take_over(earlier, before)

    def _final_optimiser(self) -> SurfelOptimiser:
        config, everything = self.config.final, torch.ones_like(self.gaussians.is_stable)
        return SurfelOptimiser(
            self.gaussians,
            everything,
            self.config.window,
            self.config.discs,
            lr_factor=config.lr_factor,
            move_centres=False,
            training=self.training,
            weight_depth=config.weight_depth,
        )

    def _draw(self, n: int) -> int:
        return int(torch.randint(n, (), generator=self.random.keyframes))

    def _undo(self) -> Callable[[], None]:
        """Also the window and the optimiser of the final passes."""
        undo_map, window, final = super()._undo(), list(self.window), self._final

        def undo() -> None:
            undo_map()
            self.window, self._final = deque(window, maxlen=self.window.maxlen), final

        return undo
