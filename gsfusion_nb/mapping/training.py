"""What a mapper optimises with: loss, optimiser, passes over the keyframes, and fits of poses and
exposures in them."""

import dataclasses
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from ..checks import check_finite, check_name, check_shape, shown
from ..code_keys import rule_fingerprint
from ..errors import ArgumentError, KindError, SequenceError
from ..optim import TrainingView, UpdateFunction, ViewLoss
from ..optim.map_step import column_argument
from ..seeding import rule_name
from ..types import GaussianParams, RenderOutput

LossFunction = Callable[[RenderOutput, TrainingView], ViewLoss]
"""``loss(rendered, view)``: the value for one view, and its gradient with respect to the rendered
images.

``rendered`` has ``rgb``, ``alpha`` and ``depth_m``. ``view`` also has ``extra``, further images of
its frame, and ``params``, the Gaussians that the step changes. The depth is the one that the
system's own loss would use: blended in GSFusion, of the discs in RTG-SLAM, of surface and Gaussians
in GPS-SLAM, where depth and alpha have no gradient. In RTG-SLAM only ``view.pixels`` are drawn and
count."""


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
        self.names = {name: rule_name(f) for name, f in self._given.items()}
        """The names of what was given, for metrics.json, config.json and the report; empty for the
        defaults."""
        for name, f in self._given.items():
            if isinstance(f, type) or not callable(f):
                raise KindError(f"{name} must be a function, got {shown(f)}")
        if optimiser is not None:
            _try_out(optimiser, self.names["optimiser"])

    def view_loss(
        self,
        rendered: RenderOutput,
        view: TrainingView,
        params: GaussianParams | None = None,
        *,
        with_geometry: bool = True,
    ) -> ViewLoss:
        """The given loss of one view.

        Args:
            rendered: The picture, without gradient.
            view: What it is compared with.
            params: The Gaussians that the step changes.
            with_geometry: Whether the system has a gradient of its depth and alpha.

        Raises:
            TypeError: the result is not a ``ViewLoss``.
            ValueError: a gradient is of another shape, not finite, of no column, or of an image
                that has none.
        """
        assert self.loss is not None
        found = self.loss(rendered, dataclasses.replace(view, params=params))
        name = f"loss {self.names['loss']!r}"
        if not isinstance(found, ViewLoss):
            raise KindError(
                f"{name} must return a ViewLoss (gsfusion_nb.optim), got {shown(found)}"
            )
        check_shape(f"value of the {name}", found.value, ())
        columns = {} if params is None else vars(params)
        for column in found.v_params or {}:
            check_name(
                f"column, which the {name} gives a gradient in v_params", column, vars(params)
            )
        likes = {f"v_{x}": getattr(rendered, x) for x in ("rgb", "depth_m", "alpha")}
        gradients = {x: getattr(found, x) for x in likes}
        likes |= {f"v_params[{x!r}]": column for x, column in columns.items()}
        gradients |= {f"v_params[{x!r}]": v for x, v in (found.v_params or {}).items()}
        for gradient_name, gradient in gradients.items():
            if gradient is not None:
                what = f"{gradient_name} of the {name}"
                check_shape(what, gradient, tuple(likes[gradient_name].shape))
                check_finite(what, gradient)
        for image in ("depth_m", "alpha"):
            if gradients[f"v_{image}"] is not None and not with_geometry:
                raise ArgumentError(
                    f"{name} returned v_{image}, but this system's {image.removesuffix('_m')} has "
                    "no gradient; leave it out"
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
        **column_argument(optimiser, "xyz_W"),
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
