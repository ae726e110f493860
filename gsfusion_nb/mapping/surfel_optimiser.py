"""Optimising some rows of an RTG-SLAM map against RGB-D views; the others do not change (Peng et
al. 2024, Eq. 7-8)."""

import dataclasses
import math
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ..checks import check_name
from ..config import DiscConfig, WindowConfig, rtg_slam
from ..evaluation.image import psnr
from ..gaussians import SurfelModel
from ..optim import RgbdLoss, RowAdam, TrainingView, rgbd_l1_vjp
from ..render import (
    Boxes,
    blended_depth_m,
    disc_depth,
    disc_depth_vjp,
    render_forward,
    render_vjp,
    view_surface,
)
from ..render.constants import OPAQUE_ALPHA
from ..seeding import DiscInputs, SeedContext, apply_rule
from ..types import Camera, Frame, GaussianParams, RenderOutput
from .training import Training

_GEOMETRY = ("xyz_W", "log_scale", "quat")

WEIGHT_DEPTH = 1.0
"""w_d of Eq. 8: weight of the depth error in metres."""

WEIGHT_REGULARISER = 1000.0
"""w_reg of Eq. 8: holds centre, rotation and scale of transparent Gaussians near their anchor
values."""


class SurfelOptimiser:
    """Adam on the rows ``trained`` of a map; of the other rows, those in ``drawn`` are rendered,
    too.

    It works on a copy of the rows, the trained ones first; ``write_back`` copies the trained ones
    to the map.

    Args:
        model: The map.
        trained: Rows to optimise. [N]
        window: Learning rates and weights of the loss.
        discs: When a ray counts as hitting a disc.
        drawn: Rows that are rendered; all by default. [N]
        seen: Rows that the views may show, from ``rows_in_view``; all by default. The others get no
            gradient, and leaving them out takes less time and changes the other gradients by
            rounding only. [N]
        lr_factor: Multiplies all learning rates.
        move_centres: False: the centres do not move.
        weight_depth: Weight of the depth loss (w_d of Eq. 8).
        all_in_view: A step on a large map also reaches rows far behind the measured depth of its
            view.
        training: Loss and optimiser, if they are given from outside.
    """

    def __init__(
        self,
        model: SurfelModel,
        trained: Bool[Tensor, " N"],
        window: WindowConfig,
        discs: DiscConfig,
        *,
        drawn: Bool[Tensor, " N"] | None = None,
        seen: Bool[Tensor, " N"] | None = None,
        lr_factor: float = 1.0,
        move_centres: bool = True,
        weight_depth: float = WEIGHT_DEPTH,
        all_in_view: bool = False,
        training: Training | None = None,
    ):
        self.training = training or Training()
        self.config = window
        self.discs = discs
        self.weight_depth = weight_depth
        self._all_in_view = all_in_view
        self._model = model
        others = ~trained if drawn is None else drawn & ~trained
        self._n_anchored = int((trained & model.is_transparent).sum())
        if seen is not None:
            trained = trained & seen
            others = others & seen
        self.rows = trained.nonzero().squeeze(1)
        """Rows of the map that are optimised."""
        self.n = len(self.rows)
        """Number of rows that are optimised; they are the first rows of ``params``."""
        self.drawn = torch.cat([self.rows, others.nonzero().squeeze(1)])
        """Rows of the map that are rendered."""
        self.params = model.params[self.drawn]
        self.trained = self.params[: self.n]
        self.steps_seen = torch.zeros(self.n, dtype=torch.int32, device=trained.device)
        """Number of steps that changed the colour of each trained row."""
        w = self.config
        rates = {
            "xyz_W": w.lr_xyz * lr_factor * move_centres,
            "log_scale": w.lr_log_scale * lr_factor,
            "quat": w.lr_xyz * lr_factor,
            "sh_dc": w.lr_sh_dc * lr_factor,
            "sh_rest": w.lr_sh_dc * lr_factor / 20,
        }
        factors = {name: f[self.rows] for name, f in model.rates.items()}
        self.adam = RowAdam(self.trained, rates, factors, update=self.training.optimiser)
        self.picture: Tensor | None = None
        """The picture [H, W, 3] before the last step."""
        self._boxes = Boxes()
        self._is_trained = torch.arange(len(self.params), device=trained.device) < self.n
        self._anchored = (self.trained.opacity_logit < 0).nonzero().squeeze(1)
        born = model.anchor
        start = (
            born
            if w.anchor == "birth"
            else {name: getattr(model.params, name) for name in _GEOMETRY}
        )
        self._anchor = {name: start[name][self.rows[self._anchored]].clone() for name in _GEOMETRY}

    def touched(
        self,
        camera: Camera,
        T_WC: Float[Tensor, "4 4"],
    ) -> Bool[Tensor, "H W"]:
        """Pixels that a trained row covers, even if other rows hide it."""
        output, _ = render_forward(self.trained, camera, T_WC, with_indices=False)
        return output.alpha > 0

    def step(
        self, view: TrainingView, outputs: Mapping[str, Tensor | None] = MappingProxyType({})
    ) -> RgbdLoss:
        """One gradient step on one view. Returns the loss before it; the picture before it is
        ``picture`` then.

        Of many rows only those are drawn and changed that the view may show.

        Args:
            view: What to compare with.
            outputs: ``v_uv`` and ``v_uv_abs`` of ``render_vjp``, to be filled for the ``drawn``
                rows. [R, 2]
        """
        discs = self.discs
        params = self.params
        is_trained = self._is_trained
        whole = any(wanted is not None for wanted in outputs.values())
        depth_m = None if self._all_in_view else view.depth_m
        part = None if whole else self._boxes.rows(params, view.camera, view.T_WC, depth_m)
        if part is not None:
            self.adam.catch_up(part[part < self.n])
            params = params[part]
            is_trained = is_trained[part]
        output, saved = render_forward(
            params,
            view.camera,
            view.T_WC,
            with_indices=False,
            opaque_alpha=discs.opaque_alpha,
            pixels=view.pixels,
        )
        hit = output.hit_index
        assert hit is not None
        options = {"max_offset": discs.max_offset, "min_cosine": discs.min_cosine}
        if discs.depth == "disc":
            depth_m = disc_depth(params, view.camera, view.T_WC, hit, **options).depth_m
        else:
            depth_m = blended_depth_m(output)
        loss = self._loss(dataclasses.replace(output, depth_m=depth_m), view)
        if discs.depth == "disc":
            g = render_vjp(saved, loss.v_rgb, rows=is_trained, **outputs)
            v_xyz, v_quat = disc_depth_vjp(
                params, view.camera, view.T_WC, hit, loss.v_depth_m, rows=is_trained, **options
            )
            g = dataclasses.replace(g, xyz_W=g.xyz_W + v_xyz, quat=g.quat + v_quat)
        else:  # of D / A: v_D = v / A,  v_A = -v D / A^2
            v_D = loss.v_depth_m / output.alpha.clamp_min(1e-6)
            g = render_vjp(saved, loss.v_rgb, v_D, -v_D * depth_m, rows=is_trained, **outputs)
        stepped = None if part is None else part[is_trained]
        self._add_regulariser(g, stepped)
        n = self.n if stepped is None else len(stepped)
        self.steps_seen[slice(None) if stepped is None else stepped] += (g.sh[:n, 0] != 0).any(
            dim=1
        )
        self.adam.step(g, stepped)
        self.picture = output.rgb
        return loss

    def _loss(self, rendered: RenderOutput, view: TrainingView) -> RgbdLoss:
        if self.training.loss is not None:
            found = self.training.view_loss(rendered, view)
            unknown = rendered.depth_m.new_tensor(math.nan)
            v_depth_m = (
                torch.zeros_like(rendered.depth_m) if found.v_depth_m is None else found.v_depth_m
            )
            return RgbdLoss(
                colour=unknown,
                depth_m=unknown,
                total=found.value,
                v_rgb=found.v_rgb,
                v_depth_m=v_depth_m,
            )
        w = self.config
        return rgbd_l1_vjp(
            rendered.rgb,
            rendered.depth_m,
            view.rgb,
            view.depth_m,
            view.pixels,
            weight_colour=w.weight_colour,
            weight_depth=self.weight_depth,
            behind_m=w.depth_behind_m,
        )

    def write_back(self, params: GaussianParams | None = None) -> None:
        """Copy the trained rows, or ``params`` instead of them, to the map."""
        self._model.will_change(self.rows)
        for name, value in vars(params or self.trained).items():
            getattr(self._model.params, name)[self.rows] = value

    def take_over(self, earlier: "SurfelOptimiser", before: Int[Tensor, " N"]) -> None:
        """Go on with Adam where an optimiser of the same map was before its rows changed; both
        train all rows.

        Args:
            earlier: The optimiser from before.
            before: For each row of the map its number then, -1 for new rows, whose moments stay
                zero. [N]
        """
        self.adam.take_over(earlier.adam, before)

    def state_dict(self) -> dict[str, Any]:
        """What cannot be computed from the map: Adam's moments and the anchors of transparent
        rows."""
        return {
            "adam": self.adam.state_dict(),
            "anchor": {name: value.clone() for name, value in self._anchor.items()},
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what ``state_dict`` saved, for the same rows."""
        self.adam.load_state_dict(state["adam"])
        for name, mine in self._anchor.items():
            mine.copy_(state["anchor"][name])

    def _add_regulariser(self, g: GaussianParams, stepped: Int[Tensor, " R"] | None) -> None:
        """Add the gradient of w_reg times the mean squared distance of transparent rows to their
        anchors.

        Args:
            g: The gradient of the trained rows, or of those that are ``stepped``.
            stepped: Rows of ``trained``, rising; None: all. [R]
        """
        if not len(self._anchored):
            return
        rows = self._anchored
        which = slice(None)
        if stepped is not None:
            which = torch.isin(rows, stepped, assume_unique=True)
            rows = torch.searchsorted(stepped, rows[which])
        for name in _GEOMETRY:
            away = getattr(self.trained, name)[self._anchored[which]] - self._anchor[name][which]
            n = self._n_anchored * away.shape[1]
            getattr(g, name)[rows] += 2 * WEIGHT_REGULARISER / n * away


def fit_image(
    frame: Frame,
    n: int,
    method: str,
    *,
    steps: int = 150,
    seed: int = 0,
) -> dict[str, float]:
    """Draw ``n`` pixels at random, seed a Gaussian at each, and optimise them on colour and depth
    of this one image (Peng et al. 2024, Fig. 7).

    Args:
        frame: The image.
        n: Number of Gaussians, at most the number of pixels with depth and normal.
        method: "disc": discs, disc depth (Eq. 5); "blended": discs, blended depth; "round": round
            Gaussians, blended depth.
        steps: Optimisation steps.
        seed: Seed of the draw; with the same seed every method gets the same pixels.

    Returns:
        Name of a column of the table -> value. Depth errors are |rendered - measured depth| over
        the pixels with both; shares are of all measured pixels.
    """
    check_name("method", method, ("disc", "blended", "round"))
    settings = rtg_slam(
        "replica", window__lr_xyz=1e-3, window__lr_sh_dc=5e-3, window__lr_log_scale=0.02
    )  # many steps
    depth = "disc" if method == "disc" else "blended"
    # the surfel to 1 sigma
    discs = dataclasses.replace(settings.discs, opaque_alpha=OPAQUE_ALPHA, depth=depth)
    generator = torch.Generator().manual_seed(seed)
    context = SeedContext(frame, generator=generator, system=DiscInputs(discs=discs))
    usable = int((context.has_depth() & (context.normals() != 0).any(dim=-1)).sum())
    options = {"share": min(1.0, n / max(usable, 1))}
    seeds = apply_rule("rtg_slam", context, options)
    if method == "round":
        seeds = dataclasses.replace(
            seeds,
            scale_m=seeds.scale_m[:, :1].expand(-1, 3).clone(),
        )
    model = SurfelModel(sh_degree=0)
    model.append(seeds)
    optimiser = SurfelOptimiser(
        model, torch.ones(len(model), dtype=torch.bool), settings.window, discs
    )
    view = TrainingView.of(frame)
    for _ in range(steps):
        optimiser.step(view)
    optimiser.write_back()
    seen = view_surface(model.params, frame.camera, frame.T_WC, discs)
    known = frame.depth_m > 0
    both = known & (seen.depth_m > 0)
    error = (seen.depth_m - frame.depth_m)[both].abs()
    return {
        "mean depth error, cm": 100 * float(error.mean()),
        "median depth error, cm": 100 * float(error.median()),
        "pixels within 1 cm, %": 100 * float((error < 0.01).sum() / known.sum()),
        "pixels with depth, %": 100 * float(both.sum() / known.sum()),
        "PSNR, dB": psnr(seen.rgb, frame.rgb),
    }
