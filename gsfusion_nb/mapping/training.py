"""What a mapper optimises with: loss, optimiser, passes over the keyframes, and fits of poses and
exposures in them."""

import dataclasses
import hashlib
from collections.abc import Callable, Iterator, Mapping
from math import radians
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from ..checks import check_finite, check_shape, shown
from ..config import OptimConfig
from ..errors import ArgumentError, KindError, SequenceError
from ..gaussians import GaussianModel
from ..geometry import se3
from ..optim import Keyframe, KeyframeList, TrainingView, UpdateFunction, ViewLoss
from ..optim.fit_view import exposed, exposed_vjp, fit_gain, pose_step, pose_system
from ..render.constants import SHOWN_ALPHA
from ..seeding import rule_fingerprint, rule_name
from ..types import Frame, RenderOutput
from .localiser import Localiser, between
from .step import GlobalStep

LossFunction = Callable[[RenderOutput, TrainingView], ViewLoss]
"""``loss(rendered, view)``: the value for one view, and its gradient with respect to the rendered
images.

``rendered`` has ``rgb``, ``alpha`` and ``depth_m``. The depth is the one that the system's own loss
would use: blended in GSFusion, of the discs in RTG-SLAM, of surface and Gaussians in GPS-SLAM,
where it has no gradient. In RTG-SLAM only ``view.pixels`` are drawn and count."""


def given_functions(loss: LossFunction | None, optimiser: UpdateFunction | None) -> dict[str, Any]:
    """Those of the two that are given, by name; a system that does not know them is not asked to
    take them."""
    return {name: f for name, f in (("loss", loss), ("optimiser", optimiser)) if f is not None}


class Training:
    """What a mapper optimises with. Without arguments it is the system's own loss and Adam.

    Both functions must depend on their arguments only: what they store is not part of a checkpoint.

    Args:
        loss: Replaces all terms about the picture and its depth. Penalties on Gaussians in the
            settings stay.
        optimiser: Replaces ``adam_update``; learning rates, and factors of rows, stay those of the
            settings.

    Raises:
        TypeError: one of them is not a function, or the optimiser returns something.
        ValueError: the optimiser does not change its parameter in place, or makes it NaN.
    """

    def __init__(self, loss: LossFunction | None = None, optimiser: UpdateFunction | None = None):
        self.loss = loss
        self.optimiser = optimiser
        self._given = given_functions(loss, optimiser)
        for name, f in self._given.items():
            if isinstance(f, type) or not callable(f):
                raise KindError(f"{name} must be a function, got {shown(f)}")
        if optimiser is not None:
            _try_out(optimiser, self.names["optimiser"])

    @property
    def names(self) -> dict[str, str]:
        """The names of what was given, for metrics.json, config.json and the report; empty for the
        defaults."""
        return {name: rule_name(f) for name, f in self._given.items()}

    def view_loss(
        self, rendered: RenderOutput, source: "Frame | Any", *, with_depth: bool = True
    ) -> ViewLoss:
        """The given loss of one view.

        Args:
            rendered: The picture, without gradient.
            source: The frame, keyframe or ``TrainingView``.
            with_depth: Whether the system has a gradient of its depth.

        Raises:
            TypeError: the result is not a ``ViewLoss``.
            ValueError: the gradient is of another shape, not finite, or of a depth that has none.
        """
        assert self.loss is not None
        view = source if isinstance(source, TrainingView) else TrainingView.of(source)
        found = self.loss(rendered, view)
        name = f"loss {self.names['loss']!r}"
        if not isinstance(found, ViewLoss):
            raise KindError(
                f"{name} must return a ViewLoss (gsfusion_nb.optim), got {shown(found)}"
            )
        check_shape(f"value of the {name}", found.value, ())
        for column, like in (("v_rgb", rendered.rgb), ("v_depth_m", rendered.depth_m)):
            gradient = getattr(found, column)
            if gradient is not None:
                check_shape(f"{column} of the {name}", gradient, tuple(like.shape))
                check_finite(f"{column} of the {name}", gradient)
        if found.v_depth_m is not None and not with_depth:
            raise ArgumentError(
                f"{name} returned v_depth_m, but this system's depth has no gradient; leave it out"
            )
        return found.detached(rendered.rgb)

    def state_dict(self) -> dict[str, dict[str, str]]:
        """Name and fingerprint of each function that is given."""
        return {
            kind: {"name": rule_name(f), "code": rule_fingerprint(f)}
            for kind, f in self._given.items()
        }

    def notes_on(
        self,
        state: dict[str, dict[str, str]],
    ) -> list[str]:
        """Sentences about a difference from the training of a checkpoint.

        Raises:
            SequenceError: the checkpoint was made with a function that is not given now.
        """
        notes = []
        now = self.state_dict()
        for kind in ("loss", "optimiser"):
            if kind in state and kind not in now:
                raise SequenceError(
                    f"this run has its own {kind}, {shown(state[kind]['name'])}, which is not in "
                    "the checkpoint: "
                    f"continue it in Python with resume_mapping(folder, {kind}=<the function>)"
                )
            if now.get(kind) != state.get(kind):
                was = shown(state[kind]["name"]) if kind in state else "the system's own"
                notes.append(
                    f"the run continued with another {kind}: {self.names[kind]!r} instead of {was}"
                )
        return notes


def _try_out(optimiser: UpdateFunction, name: str) -> None:
    """Take one step, late enough that a warm-up is over, on two rows with gradient 1."""
    name = f"optimiser {name!r}"
    param = torch.zeros(2, 3)
    m = torch.zeros(2, 3)
    v = torch.zeros(2, 3)
    returned: Any = optimiser(
        param,
        torch.ones(2, 3),
        m,
        v,
        torch.full((2,), 1000),
        lr=0.1,
    )
    if returned is not None:
        raise KindError(
            f"{name} must change param in place and return nothing, got {shown(returned)}"
        )
    if not _all_finite(param, m, v):
        raise ArgumentError(f"{name} makes NaN or infinity from a gradient of 1")
    if not param.any():
        raise ArgumentError(
            f"{name} must change param in place (param -= ..., not param = param - ...)"
        )


def _all_finite(*values: Tensor) -> bool:
    return all(bool(value.isfinite().all()) for value in values)


class KeyframePasses:
    """Each pass visits all keyframes once, in a new random order."""

    def __init__(self):
        self.done = 0
        """Number of finished passes."""
        self.queue: list[int] = []
        """Keyframes that the current pass has not visited yet."""

    @property
    def begun(self) -> bool:
        """Whether at least one keyframe was visited."""
        return self.done > 0 or len(self.queue) > 0

    def run(
        self,
        passes: int,
        n_keyframes: int,
        generator: torch.Generator,
        optimise: Callable[[int], Float[Tensor, ""]],
    ) -> Iterator[GlobalStep]:
        """Visit every keyframe ``passes`` times; ``optimise(i)`` takes one step on the i-th and
        returns its loss.

        A pass that was interrupted is finished first and counts as one of them.
        """
        begun = len(self.queue) > 0
        n_steps = (passes - begun) * n_keyframes + len(self.queue)
        step = 0
        for pass_index in range(passes if n_keyframes else 0):
            if not self.queue:
                self.queue = torch.randperm(n_keyframes, generator=generator).tolist()
            while self.queue:
                loss = optimise(self.queue.pop(0))
                step += 1
                self.done += not self.queue
                yield GlobalStep(pass_index=pass_index, step=step, n_steps=n_steps, loss_value=loss)

    def state_dict(self) -> dict[str, Any]:
        """The state of the passes."""
        return {"done": self.done, "queue": list(self.queue)}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what ``state_dict`` saved."""
        self.done = state["done"]
        self.queue = list(state["queue"])


class KeyframeFits:
    """What the passes after the scan fit to each keyframe, besides the Gaussians: its exposure and
    its pose.

    Exposures (``optim.fit_exposure``) are stored with the keyframes, so that the map has the mean
    brightness of the pictures.

    With ``optim.refine_poses`` a keyframe moves one step towards the pose at which the map fits it
    whenever it is visited, because the map's picture of it is there anyway. A prior holds each pose
    at that of the data. After each pass, the mean motion of all keyframes is taken back, by moving
    map and keyframes together, so that the map stays where the data puts it; and the frames between
    keyframes follow them. The poses are the localiser's and the keyframes'.
    """

    def __init__(self, optim: OptimConfig, localiser: Localiser):
        self._optim = optim
        self._localiser = localiser
        sigma = [optim.pose_sigma_m] * 3 + [radians(optim.pose_sigma_deg)] * 3
        self._sigma = torch.tensor(sigma, dtype=torch.float64)
        self._exposure: Tensor | None = None

    def expose(
        self, keyframes: KeyframeList, keyframe: Keyframe, output: RenderOutput
    ) -> RenderOutput:
        """The map's picture with the exposure of the keyframe; that of its next visit is fitted to
        the map of now."""
        if not self._optim.fit_exposure:
            return output
        fitted = fit_gain(output.rgb, keyframe.rgb, output.alpha >= SHOWN_ALPHA)
        keyframes.set_gain(keyframe.index, fitted)
        self._exposure = fitted if keyframe.gain is None else keyframe.gain.to(fitted)
        return dataclasses.replace(output, rgb=exposed(output.rgb, self._exposure))

    def expose_vjp(
        self, output: RenderOutput, v_rgb: Float[Tensor, "H W 3"]
    ) -> Float[Tensor, "H W 3"]:
        """The gradient with respect to the map's picture, from that of the exposed picture, of the
        last ``expose``."""
        return (
            v_rgb if self._exposure is None else exposed_vjp(output.rgb, self._exposure, v_rgb)[0]
        )

    def move(self, keyframes: KeyframeList, keyframe: Keyframe, shown: RenderOutput) -> None:
        """Move a keyframe one step, by the map's picture of it that its last gradient was computed
        from."""
        if not self._optim.refine_poses:
            return
        row = self._localiser.frame_indices.index(keyframe.index)
        system = pose_system(shown, keyframe.rgb, keyframe.camera)
        if system.share >= LEAST_SHARE:
            T_WC = pose_step(system, keyframe.T_WC, self._localiser.given[row], self._sigma)
            keyframes.set_pose(keyframe.index, T_WC)
            self._localiser.refine(row, T_WC.cpu())

    def end_pass(self, keyframes: KeyframeList, gaussians: GaussianModel) -> None:
        """Take back what all keyframes share: it belongs to the map, and no picture can tell it."""
        if self._optim.refine_poses:
            self._take_back_motion(keyframes, gaussians)
        gains = {k.index: k.gain.log() for k in keyframes if k.gain is not None}
        if gains:  # a factor that all share is the map's brightness
            mean = torch.stack(list(gains.values())).mean(0)
            for index, gain in gains.items():
                keyframes.set_gain(index, (gain - mean).exp())

    def _take_back_motion(self, keyframes: KeyframeList, gaussians: GaussianModel) -> None:
        """Where all keyframes move together by G, T_i = G T_i(given), the pictures do not change:
        nothing holds G."""
        poses = self._localiser.poses
        given = self._localiser.given
        rows = sorted(self._localiser.frame_indices.index(k.index) for k in keyframes)
        T_WC, T_given = (torch.stack([p[r] for r in rows]).double() for p in (poses, given))
        back = se3.exp(-se3.log(T_WC @ se3.inverse(T_given)).mean(0))
        gaussians.will_change()
        gaussians.move(back.to(gaussians.device, torch.float32).expand(len(gaussians), 4, 4))
        for keyframe in list(keyframes):
            row = self._localiser.frame_indices.index(keyframe.index)
            T_new = (back @ poses[row].double()).float()
            keyframes.set_pose(keyframe.index, T_new)
            self._localiser.refine(row, T_new)
        self._localiser.follow(rows)


def exposure_between(
    fitted: Mapping[int, Float[Tensor, " 3"]],
    index: int,
) -> Float[Tensor, " 3"]:
    """The exposure of any frame of the source by those of the frames before and after it,
    interpolated in stops.

    Args:
        fitted: Number of a frame -> its exposure; at least one.
        index: Number of the frame; its own picture is not used.
    """
    indices = sorted(fitted)
    stops = torch.stack([fitted[i].double().log2().cpu() for i in indices])
    return between(torch.tensor(indices), stops, index).exp2().float()


LEAST_SHARE = 0.5
"""A view moves only if the map shows at least this share of its pixels."""


class RandomStreams:
    """Three generators that follow from one seed.

    A rule that draws more or fewer numbers than another changes neither which keyframes are
    revisited nor the order of the passes after the scan.

    Args:
        seed: Seed of the run, ``config.seed``.
    """

    def __init__(self, seed: int):
        self.rule = _generator(seed, "rule")
        """For the seeding rule: ``ctx.generator``."""
        self.keyframes = torch.Generator().manual_seed(seed)
        """For the views that are optimised while scanning."""
        self.passes = _generator(seed, "passes")
        """For the order of the keyframes in the passes after the scan."""

    def state_dict(self) -> dict[str, Tensor]:
        """State of each generator."""
        return {name: generator.get_state() for name, generator in vars(self).items()}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Set the generators to what ``state_dict`` returned."""
        for name, generator in vars(self).items():
            generator.set_state(state[name])


def _generator(seed: int, stream: str) -> torch.Generator:
    digest = hashlib.blake2b(f"{stream} {seed}".encode(), digest_size=7).digest()
    return torch.Generator().manual_seed(int.from_bytes(digest, "little"))
