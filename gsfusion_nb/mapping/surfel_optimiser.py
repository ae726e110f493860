"""Optimising some rows of an RTG-SLAM map against RGB-D views; the others do not change (Peng et
al. 2024, Eq. 7-8)."""

import dataclasses
from collections.abc import Mapping
from functools import partial
from types import MappingProxyType
from typing import Any

import torch
from jaxtyping import Bool, Int
from torch import Tensor

from ..config import DiscConfig, WindowConfig
from ..gaussians import GaussianModel, SurfelModel
from ..large_maps import Boxes, MapPart, params_now
from ..optim import (
    AdamSettings,
    ColumnRates,
    PictureVjp,
    TrainingView,
    ViewLoss,
    ViewStep,
    optimise_view,
    rgbd_l1_vjp,
    take_missed_steps,
)
from ..render import (
    blended_depth_m,
    disc_depth,
    disc_depth_vjp,
    render_forward,
    render_vjp,
)
from ..render.constants import NEAR_PLANE_M
from ..types import ALL_ROWS, GaussianParams, MapRows, RenderOutput
from .training import Training

_GEOMETRY = ("xyz_W", "log_scale", "quat")

WEIGHT_DEPTH = 1.0
"""w_d of Eq. 8: weight of the depth error in metres."""

WEIGHT_REGULARISER = 1000.0
"""w_reg of Eq. 8: holds centre, rotation and scale of transparent Gaussians near their anchor
values."""

BETA1 = 0.9
BETA2 = 0.999
EPS = 1e-15
"""Of Adam: the values of the released code, which are those of 3D Gaussian splatting."""


class SurfelOptimiser:
    """Adam on some rows of a map; others are drawn with them and stay as they are.

    It works on copies of the rows, whose moments begin at zero; ``write_back`` copies the trained
    ones to the map.

    Args:
        model: The map.
        is_trained: Rows to optimise. [N]
        window: Learning rates and weights of the loss.
        discs: When a ray counts as hitting a disc.
        is_drawn: Rows that are rendered; all by default. [N]
        is_in_view: Rows that the views may show, from ``rows_in_view``; all by default. The others
            get no gradient, and leaving them out takes less time and changes the other gradients by
            rounding only. [N]
        lr_factor: Multiplies all learning rates.
        move_centres: False: the centres do not move.
        weight_depth: Weight of the depth loss (w_d of Eq. 8).
        all_in_view: A step on a large map also reaches rows far behind the measured depth of its
            view.
        training: Loss and optimiser, if they are given from outside.
        near_m: Nearer discs are not drawn, metres.
    """

    def __init__(
        self,
        model: SurfelModel,
        is_trained: Bool[Tensor, " N"],
        window: WindowConfig,
        discs: DiscConfig,
        *,
        is_drawn: Bool[Tensor, " N"] | None = None,
        is_in_view: Bool[Tensor, " N"] | None = None,
        lr_factor: float = 1.0,
        move_centres: bool = True,
        weight_depth: float = WEIGHT_DEPTH,
        all_in_view: bool = False,
        training: Training | None = None,
        near_m: float = NEAR_PLANE_M,
    ):
        self.training = training or Training()
        self.config = window
        self.discs = discs
        self.weight_depth = weight_depth
        self._near_m = near_m
        self._all_in_view = all_in_view
        self._model = model
        is_frozen = ~is_trained if is_drawn is None else is_drawn & ~is_trained
        self._n_anchors = int((is_trained & model.is_transparent).sum())
        if is_in_view is not None:
            is_trained = is_trained & is_in_view
            is_frozen = is_frozen & is_in_view
        self.rows = is_trained.nonzero().squeeze(1)
        """Rows of the map that are optimised."""
        self.n = len(self.rows)
        """Number of rows that are optimised; they are the first of ``drawn_rows``."""
        self.drawn_rows = torch.cat([self.rows, is_frozen.nonzero().squeeze(1)])
        """Rows of the map that are rendered."""
        self.copies = GaussianModel(model.sh_degree, model.device)
        """Copies of the drawn rows, with moments of their own."""
        self.copies.extend(model.params[self.drawn_rows])
        for name, factors in model.rates.items():
            self.copies.rates.use(name)[:] = factors[self.drawn_rows]
        self.params = self.copies.params
        self.trained_params = self.params[: self.n]
        self.colour_steps = torch.zeros(self.n, dtype=torch.int32, device=model.device)
        """Number of steps that changed the colour of each trained row."""
        self.adam = AdamSettings(
            rates=ColumnRates(
                xyz_W=window.lr_xyz * lr_factor * move_centres,
                log_scale=window.lr_log_scale * lr_factor,
                quat=window.lr_xyz * lr_factor,
                opacity_logit=0.0,  # Peng et al. 2024: lr_alpha = 0
                sh_dc=window.lr_sh_dc * lr_factor,
                sh_rest=window.lr_sh_dc * lr_factor / 20,
            ),
            beta1=BETA1,
            beta2=BETA2,
            eps=EPS,
            steps="shared",
        )
        self._boxes = Boxes()
        self._transparent = (self.trained_params.opacity_logit < 0).nonzero().squeeze(1)
        start = (
            model.anchor
            if window.anchor == "birth"
            else {name: getattr(model.params, name) for name in _GEOMETRY}
        )
        rows = self.rows[self._transparent]
        self._anchor = {name: start[name][rows].clone() for name in _GEOMETRY}

    def step(
        self, view: TrainingView, outputs: Mapping[str, Tensor | None] = MappingProxyType({})
    ) -> ViewStep:
        """One gradient step on one view, of which it returns what was before it.

        Of many rows only those are drawn and changed that the view may show, after the steps that
        they missed. A view that shows most of them changes all, without these steps.

        Args:
            view: What to compare with.
            outputs: ``v_uv`` and ``v_uv_abs`` of ``render_vjp``, to be filled for the
                ``drawn_rows``. [R, 2]
        """
        is_counted = any(output is not None for output in outputs.values())
        rows = ALL_ROWS if is_counted else self._rows_in_view(view)
        part, frozen_params = self._part(rows)
        self.copies.undo_log.will_change(part.rows)
        if self.training.optimiser is None and isinstance(rows, Tensor):
            take_missed_steps(part, self.adam)

        def regularise(gradients: GaussianParams) -> float:
            self.colour_steps[part.rows] += (gradients.sh[:, 0] != 0).any(dim=1)
            self._add_regulariser(gradients, part)
            return 0.0

        step = optimise_view(
            part,
            lambda params: render_discs(params, frozen_params, view, self.discs, self._near_m),
            lambda picture: (self._loss(picture, view, part.params), None),
            self.adam,
            regulariser=regularise,
            update=self.training.optimiser,
            outputs=outputs,
        )
        part.write_back()
        return step

    def _rows_in_view(self, view: TrainingView) -> MapRows:
        """Rows of ``params`` that a view may show, rising."""
        depth_m = None if self._all_in_view else view.depth_m
        return self._boxes.rows(self.params, view.camera, view.T_WC, depth_m)

    def _part(self, rows: MapRows) -> tuple[MapPart, GaussianParams]:
        """What of these rows is trained, and the parameters of the others."""
        if isinstance(rows, slice):
            return MapPart(self.copies, slice(self.n)), self.params[self.n :]
        if self.n == len(self.params):
            return MapPart(self.copies, rows), self.params[:0]
        numbers = torch.arange(len(self.params), device=self.rows.device)[rows]
        is_trained = numbers < self.n
        return MapPart(self.copies, numbers[is_trained]), self.params[numbers[~is_trained]]

    def _loss(self, picture: RenderOutput, view: TrainingView, params: GaussianParams) -> ViewLoss:
        if self.training.loss is not None:
            return self.training.view_loss(picture, view, params)
        loss = rgbd_l1_vjp(
            picture.rgb,
            picture.depth_m,
            view.rgb,
            view.depth_m,
            view.pixels,
            weight_colour=self.config.weight_colour,
            weight_depth=self.weight_depth,
            behind_m=self.config.depth_behind_m,
        )
        return ViewLoss(value=loss.total, v_rgb=loss.v_rgb, v_depth_m=loss.v_depth_m)

    def write_back(self, params: GaussianParams | None = None) -> None:
        """Copy the trained rows, or ``params`` instead of them, to the map."""
        self._model.undo_log.will_change(self.rows)
        for name, value in vars(params or self.trained_params).items():
            getattr(self._model.params, name)[self.rows] = value

    def take_missed_steps(self) -> None:
        """Bring the trained rows up to date that were out of view in some steps."""
        late_rows = self.copies.clock.steps_missed[: self.n].nonzero()[:, 0]
        if self.training.optimiser is not None or not len(late_rows):
            return
        self.copies.undo_log.will_change(late_rows)
        part = MapPart(self.copies, late_rows)
        take_missed_steps(part, self.adam)
        part.write_back()

    def params_now(self, rows: MapRows = ALL_ROWS) -> GaussianParams:
        """The drawn rows, or these of them, as they are with the steps that they missed."""
        if self.training.optimiser is not None:
            return self.params[rows]
        return params_now(self.copies, partial(take_missed_steps, config=self.adam), rows)

    def take_over(self, earlier: "SurfelOptimiser", old_rows: Int[Tensor, " N"]) -> None:
        """Go on with Adam where an optimiser of the same map was before its rows changed; both
        train all rows.

        Args:
            earlier: The optimiser from before.
            old_rows: For each row of the map its number then, -1 for new rows, whose moments stay
                zero. [N]
        """
        is_old = old_rows >= 0
        old_rows = old_rows[is_old]
        clock = self.copies.clock
        clock.advance(earlier.copies.clock.count)
        clock.last[is_old] = earlier.copies.clock.last[old_rows]
        for mine, theirs in zip(_moments(self.copies), _moments(earlier.copies), strict=True):
            for name, values in vars(theirs).items():
                getattr(mine, name)[is_old] = values[old_rows]

    def state_dict(self) -> dict[str, Any]:
        """What cannot be computed from the map: Adam's moments and the anchors of transparent
        rows."""
        mean, square = _moments(self.copies)
        moments = {
            name: [column[: self.n].clone() for column in (values, getattr(square, name))]
            for name, values in vars(mean).items()
        }
        clock = self.copies.clock
        return {
            "adam": {
                "steps": clock.count,
                "last": clock.last[: self.n].clone(),
                "moments": moments,
            },
            "anchor": {name: value.clone() for name, value in self._anchor.items()},
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what ``state_dict`` saved, for the same rows."""
        clock = self.copies.clock
        clock.advance(state["adam"]["steps"])
        clock.last[: self.n] = state["adam"]["last"].to(clock.last)
        for name, values in state["adam"]["moments"].items():
            for moments, value in zip(_moments(self.copies), values, strict=True):
                getattr(moments, name)[: self.n] = value
        for name, mine in self._anchor.items():
            mine.copy_(state["anchor"][name])

    def _add_regulariser(self, g: GaussianParams, part: MapPart) -> None:
        """Add the gradient of w_reg times the mean squared distance of transparent rows to their
        anchors (third term of Eq. 8).

        Args:
            g: The gradient of the part.
            part: Rows of ``trained_params``, rising.
        """
        if not len(self._transparent):
            return
        rows = self._transparent
        anchors = ALL_ROWS
        if isinstance(part.rows, Tensor):
            anchors = torch.isin(rows, part.rows, assume_unique=True)
            rows = torch.searchsorted(part.rows, rows[anchors])
        for name in _GEOMETRY:
            offset = getattr(part.params, name)[rows] - self._anchor[name][anchors]
            n = self._n_anchors * offset.shape[1]
            getattr(g, name)[rows] += 2 * WEIGHT_REGULARISER / n * offset


def _moments(model: GaussianModel) -> tuple[GaussianParams, GaussianParams]:
    return model.moments.exp_avg, model.moments.exp_avg_sq


def render_discs(
    trained: GaussianParams,
    frozen: GaussianParams,
    view: TrainingView,
    discs: DiscConfig,
    near_m: float = NEAR_PLANE_M,
) -> tuple[RenderOutput, PictureVjp]:
    """Discs as a camera sees them, and the gradient of those that are trained.

    Args:
        trained: Discs whose gradient is wanted.
        frozen: Discs that are drawn with them.
        view: Camera, pose, and the pixels that are drawn.
        discs: When a ray counts as hitting a disc, and which depth the picture has.
        near_m: Nearer discs are not drawn, metres.
    """
    n = len(trained)
    params = _joined(trained, frozen) if len(frozen) else trained
    rows = torch.arange(len(params), device=params.xyz_W.device) < n
    output, saved = render_forward(
        params,
        view.camera,
        view.T_WC,
        with_indices=False,
        opaque_alpha=discs.opaque_alpha,
        pixels=view.pixels,
        near_m=near_m,
    )
    hit_index = output.hit_index
    assert hit_index is not None
    options = {"max_offset": discs.max_offset, "min_cosine": discs.min_cosine}
    if discs.depth == "disc":
        depth_m = disc_depth(params, view.camera, view.T_WC, hit_index, **options).depth_m
    else:
        depth_m = blended_depth_m(output)

    def vjp(
        v_rgb: Tensor,
        v_depth_m: Tensor | None,
        v_alpha: Tensor | None,
        **outputs: Tensor | None,
    ) -> GaussianParams:
        if v_depth_m is None:
            v_depth_m = torch.zeros_like(depth_m)
        if discs.depth == "disc":
            g = render_vjp(saved, v_rgb, None, v_alpha, rows=rows, **outputs)
            v_xyz, v_quat = disc_depth_vjp(
                params, view.camera, view.T_WC, hit_index, v_depth_m, rows=rows, **options
            )
            g = dataclasses.replace(g, xyz_W=g.xyz_W + v_xyz, quat=g.quat + v_quat)
        else:  # of D / A: v_D = v / A,  v_A = -v D / A^2
            v_D = v_depth_m / output.alpha.clamp_min(1e-6)
            v_A = -v_D * depth_m
            v_A = v_A if v_alpha is None else v_A + v_alpha
            g = render_vjp(saved, v_rgb, v_D, v_A, rows=rows, **outputs)
        return g[:n]

    return dataclasses.replace(output, depth_m=depth_m), vjp


def _joined(first: GaussianParams, second: GaussianParams) -> GaussianParams:
    return GaussianParams(
        **{name: torch.cat([rows, getattr(second, name)]) for name, rows in vars(first).items()}
    )
