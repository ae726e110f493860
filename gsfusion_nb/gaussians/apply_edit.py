"""How an edit changes the rows of a map: parameters, moments, birth, tag and states together."""

import math
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from ..backends import observed
from ..geometry import quaternion
from ..geometry.spherical_harmonics import rgb_to_sh_dc
from .edit import STORED, Edit
from .moments import clear_moments

SPLIT_SHRINKS = 1.6
"""A half of a split Gaussian is smaller by this factor (code released with Kerbl et al. 2023)."""

MOST_COPIES = 51
"""Largest number of copies that ``shared`` counts, as in gsplat; more are treated as this many."""


def shared(
    opacity: Float[Tensor, " N"],
    scale_m: Float[Tensor, "N 3"],
    copies: Int[Tensor, " N"],
    min_opacity: float = 0.005,
) -> tuple[Float[Tensor, " N"], Float[Tensor, "N 3"]]:
    """Opacity and scale of each of n equal Gaussians at one place that together look as one
    Gaussian did.

        o' = 1 - (1 - o)^(1/n),   s' = s o / sum_{j=1..n} C(n, j) (-1)^(j-1) o'^j / sqrt(j)

    Args:
        opacity: o of the one Gaussian, 0..1. [N]
        scale_m: s, standard deviations, metres. [N, 3]
        copies: n, itself included; at least 1. [N]
        min_opacity: Smallest o' that is returned; s' is that of the exact o'.

    Differentiable: no.
    Source: Kheradmand et al. 2024, Eq. 9; there the sum is written twice, over i <= n of
    C(i - 1, j - 1).
    """
    n = copies.clamp(1, MOST_COPIES).double()
    j = torch.arange(1, MOST_COPIES + 1, dtype=torch.float64, device=opacity.device)
    share = -torch.expm1(torch.log1p(-opacity.double()) / n)
    binomial = torch.tensor(
        [[math.comb(k, int(i)) for i in range(1, MOST_COPIES + 1)] for k in range(MOST_COPIES + 1)],
        dtype=torch.float64,
        device=opacity.device,
    )
    signs = 1 - 2 * ((j - 1) % 2)
    total = (binomial[n.long()] * signs * share[:, None] ** j / j.sqrt()).sum(1)
    scale = scale_m * (opacity.double() / total)[:, None].to(scale_m)
    one = 1 - torch.finfo(torch.float32).eps
    return share.clamp(min_opacity, one).to(opacity), torch.where((n > 1)[:, None], scale, scale_m)


@observed
def apply_edit(
    model: Any, edit: Edit, generator: torch.Generator, frame_index: int = 0
) -> Int[Tensor, " M"]:
    """Change the rows of ``model`` as its method ``edit`` says (``GaussianModel``)."""
    n_before = len(model)
    edit = edit.resolved(model.params.sh, "state" in model.columns)
    for name, factors in edit.rates.items():
        model.rates.use(name)[:] = factors
    for name, (rows, values) in edit.set.items():
        model.set_rows(*_as_stored(model, name, rows, values))
    if edit.reset_opacity is not None:
        model.params.opacity_logit.clamp_(
            max=math.log(edit.reset_opacity / (1 - edit.reset_opacity))
        )
        clear_moments(model, parameter="opacity_logit")
    if edit.relocate is not None:
        _relocate(model, *edit.relocate, edit.min_opacity)
    if edit.clone is not None:
        _clone(model, edit.clone, edit.clone_shares, edit.min_opacity)
    if edit.split is not None:
        _split_rows(model, edit.split, edit.split_shares, generator)
    if edit.add is not None:
        model.append(edit.add, frame_index)
    origin = torch.arange(len(model), device=model.device)
    origin[n_before:] = -1
    keep_mask = torch.ones(len(model), dtype=torch.bool, device=model.device)
    if edit.keep is not None:
        keep_mask[:n_before] = edit.keep
    if edit.split is not None:
        keep_mask[edit.split] = False
    if edit.keep is not None or edit.split is not None:
        model.keep(keep_mask)
    return origin[keep_mask]


def _as_stored(
    model: Any,
    name: str,
    rows: Tensor,
    values: Tensor,
) -> tuple[str, Tensor, Tensor]:
    """Column, rows and values of ``Edit.set`` as the map stores them."""
    if name == "scale_m":
        return "log_scale", rows, values.log()
    if name == "opacity":
        return "opacity_logit", rows, values.logit()
    if name == "rgb":
        sh = model.params.sh[rows]
        sh[:, 0] = rgb_to_sh_dc(values)
        return "sh", rows, sh
    return name, rows, values


def _share(
    model: Any,
    rows: Int[Tensor, " M"],
    min_opacity: float,
) -> Int[Tensor, " R"]:
    """Give every row that is named k times the opacity and scale of one of k + 1 copies; returns
    those rows, once."""
    distinct_rows, times = rows.unique(return_counts=True)
    params = model.params
    opacity, scale_m = shared(
        params.opacity_logit[distinct_rows].sigmoid(),
        params.log_scale[distinct_rows].exp(),
        times + 1,
        min_opacity,
    )
    model.set_rows("opacity_logit", distinct_rows, opacity.logit())
    model.set_rows("log_scale", distinct_rows, scale_m.log())
    return distinct_rows


def _relocate(model: Any, source: Tensor, target: Tensor, min_opacity: float) -> None:
    distinct_rows = _share(model, target, min_opacity)
    columns = model.columns
    for name in (*STORED, "birth_frame", "tag", *(f"rate.{name}" for name in model.rates)):
        model.set_rows(name, source, columns[name][target])
    clear_moments(model, distinct_rows)
    model.memory.reset(distinct_rows)
    model.as_new(distinct_rows if "state" not in columns else torch.cat([distinct_rows, source]))


def _clone(model: Any, rows: Tensor, shares: bool, min_opacity: float) -> None:
    if shares:
        _share(model, rows, min_opacity)
    copies = _copy_rows(model, rows)
    if shares:
        model.memory.reset(copies)


def _copy_rows(model: Any, rows: Tensor) -> slice:
    """Append a copy of each of these rows, with zero moments; returns which the copies are."""
    copies = model.columns.copy_rows(rows)
    clear_moments(model, copies)
    model.as_new(copies)
    return copies


def _split_rows(model: Any, rows: Tensor, shares: bool, generator: torch.Generator) -> None:
    params = model.params
    scale_m = params.log_scale[rows].exp()
    R = quaternion.to_matrix(params.quat[rows])
    noise = torch.randn(
        2,
        len(rows),
        3,
        generator=generator,
        device=generator.device,
    ).to(scale_m)
    offset_m = torch.einsum("nij,nj,bnj->bni", R, scale_m, noise)
    centres = params.xyz_W[rows] + offset_m
    logit = params.opacity_logit[rows]
    new = torch.arange(
        len(model),
        len(model) + 2 * len(rows),
        device=rows.device,
    )
    _copy_rows(model, rows.repeat(2))
    model.set_rows("xyz_W", new, centres.reshape(-1, 3))
    model.set_rows(
        "log_scale",
        new,
        (scale_m / SPLIT_SHRINKS).log().repeat(2, 1),
    )
    if shares:
        model.set_rows(
            "opacity_logit",
            new,
            (1 - (1 - logit.sigmoid()).sqrt()).logit().repeat(2),
        )
