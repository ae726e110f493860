"""One step of Adam on every row of a map, or of one parameter.

Cases of ``adam_update`` and ``adam_update_map``: every way of counting steps, on parameters of
every shape.
"""

import functools
from collections.abc import Iterator

import torch
from torch import Tensor

from gsfusion_nb.optim import ColumnRates, adam_update, adam_update_map
from gsfusion_nb.types import GaussianParams

from . import Case, make_params

_SHAPES = ((0, 3), (1,), (7, 3), (2100, 16, 3))
_MAPS = ((0, 0), (1, 1), (50, 2), (2099, 3))
"""Rows and SH degree."""
_RATES = ColumnRates(
    xyz_W=0.01, log_scale=0.02, quat=0.03, opacity_logit=0.04, sh_dc=0.05, sh_rest=0.06
)
_MOMENTS = {"beta1": 0.9, "beta2": 0.999, "eps": 1e-15}


def cases() -> Iterator[Case]:
    """For each operation one for each kind of step count, and one for the rows in use of a map's
    buffer."""
    for steps in ("none", "shared", "per_row"):
        run = functools.partial(_parameters, steps)
        run_map = functools.partial(_maps, steps)
        yield Case(name=f"step count {steps!r}", operations=("adam_update",), run=run)
        yield Case(name=f"map, step count {steps!r}", operations=("adam_update_map",), run=run_map)
    yield Case(name="rows of a larger buffer", operations=("adam_update",), run=_part_of_a_buffer)
    yield Case(name="rows of a larger map", operations=("adam_update_map",), run=_part_of_a_map)


def _parameters(
    steps: str,
    device: torch.device,
    dtype: torch.dtype,
) -> dict[str, Tensor]:
    results = {}
    for shape in _SHAPES:
        updated = _three_updates(shape, steps, device, dtype)
        results |= {f"{name} {'x'.join(map(str, shape))}": value for name, value in updated.items()}
    return results


def _maps(
    steps: str,
    device: torch.device,
    dtype: torch.dtype,
) -> dict[str, Tensor]:
    results = {}
    for n, sh_degree in _MAPS:
        maps = [make_params(sh_degree, device, dtype, n=n) for _ in range(4)]
        results |= _three_updates_of(maps, steps, f"{n} rows, SH {sh_degree}")
    return results


def _three_updates(
    shape: tuple[int, ...], steps: str, device: torch.device, dtype: torch.dtype
) -> dict[str, Tensor]:
    g = torch.Generator().manual_seed(0)
    gradients = torch.randn(3, *shape, generator=g).to(device, dtype)
    lr = torch.rand(shape[1:], generator=g).to(device, dtype) if len(shape) > 1 else 0.1
    param, exp_avg, exp_avg_sq = (
        torch.full(shape, x, device=device, dtype=dtype) for x in (1.0, 0.0, 0.0)
    )
    for t, gradient in enumerate(gradients, start=1):
        counts = _count(steps, t, param)
        adam_update(param, gradient, exp_avg, exp_avg_sq, counts, lr=lr, **_MOMENTS)
    return {"param": param, "exp_avg": exp_avg, "exp_avg_sq": exp_avg_sq}


def _count(steps: str, t: int, param: Tensor) -> int | Tensor | None:
    """The step counts of rows of five ages; the oldest have taken a million steps, which is many
    for float32."""
    ages = torch.tensor(
        [0, 1, 10, 1000, 10**6],
        dtype=torch.int32 if t % 2 else torch.int64,
    )
    rows = ages[torch.arange(len(param)) % 5].to(param.device) + t
    return {"none": None, "shared": t, "per_row": rows}[steps]


def _three_updates_of(
    maps: list[GaussianParams],
    steps: str,
    name: str,
) -> dict[str, Tensor]:
    params, gradients, exp_avg, exp_avg_sq = maps
    for moment in (exp_avg, exp_avg_sq):
        for column in vars(moment).values():
            column.zero_()
    for t in (1, 2, 3):
        turned = GaussianParams(**{k: g.roll(t, 0) for k, g in vars(gradients).items()})
        counts = _count(steps, t, params.xyz_W)
        adam_update_map(params, turned, exp_avg, exp_avg_sq, counts, rates=_RATES, **_MOMENTS)
    return _columns(params, exp_avg, exp_avg_sq, f", {name}")


def _columns(
    params: GaussianParams, exp_avg: GaussianParams, exp_avg_sq: GaussianParams, what: str = ""
) -> dict:
    rows = {"param": params, "exp_avg": exp_avg, "exp_avg_sq": exp_avg_sq}
    return {
        f"{kind} {k}{what}": column
        for kind, columns in rows.items()
        for k, column in vars(columns).items()
    }


def _part_of_a_map(device: torch.device, dtype: torch.dtype) -> dict[str, Tensor]:
    """The other rows stay as they are; rows may begin at any address, and a gradient may have
    gaps."""
    params, gradients, exp_avg, exp_avg_sq = (make_params(1, device, dtype, n=60) for _ in range(4))
    for column in vars(exp_avg_sq).values():
        column.square_()
    parts = (
        (slice(20), gradients[:20]),
        (slice(21, 41), gradients[21:41]),
        (slice(21, 41), gradients[21::2]),
    )
    for rows, gradient in parts:
        some = [whole[rows] for whole in (params, exp_avg, exp_avg_sq)]
        adam_update_map(
            some[0],
            gradient,
            some[1],
            some[2],
            7,
            rates=_RATES,
            **_MOMENTS,
        )
    return _columns(params, exp_avg, exp_avg_sq)


def _part_of_a_buffer(device: torch.device, dtype: torch.dtype) -> dict[str, Tensor]:
    """The other rows stay as they are; a gradient may have gaps."""
    buffer, exp_avg, exp_avg_sq = (torch.zeros(10, 3, device=device, dtype=dtype) for _ in range(3))
    gradient = torch.arange(24.0, device=device, dtype=dtype).view(4, 6) - 7
    for g in (gradient[:, :3].contiguous(), gradient[:, ::2]):
        adam_update(
            buffer[:4],
            g,
            exp_avg[:4],
            exp_avg_sq[:4],
            None,
            lr=1.0,
            **_MOMENTS,
        )
    return {"buffer": buffer, "exp_avg": exp_avg, "exp_avg_sq": exp_avg_sq}
