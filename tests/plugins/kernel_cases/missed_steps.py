"""Steps of Adam that rows missed, of every column of a map.

Cases of ``missed_steps_map``: rows that missed nothing, one step and many; moments that are zero;
no rows; the rows in use of a larger map.
"""

import functools
from collections.abc import Iterator

import torch
from torch import Tensor

from gsfusion_nb.optim import ColumnRates
from gsfusion_nb.optim.missed_steps import MissedSteps, missed_steps_map

from . import Case, make_params

_RATES = ColumnRates(
    xyz_W=0.01, log_scale=0.02, quat=0.03, opacity_logit=0.0, sh_dc=0.05, sh_rest=0.06
)


def cases() -> Iterator[Case]:
    """One for each number of rows and SH degree."""
    for n, sh_degree, first in ((0, 0, 0), (50, 1, 0), (2100, 0, 0), (2100, 3, 0), (60, 2, 7)):
        yield Case(
            name=f"{n} rows from {first}, SH {sh_degree}",
            operations=("missed_steps_map",),
            run=functools.partial(_run, n, sh_degree, first),
        )


def _run(
    n: int, sh_degree: int, first: int, device: torch.device, dtype: torch.dtype
) -> dict[str, Tensor]:
    whole = [make_params(sh_degree, device, dtype, n=n) for _ in range(3)]
    for column in vars(whole[2]).values():
        column.square_()
        column[::9] = 0.0
    maps = [rows[first:] for rows in whole]
    missed = torch.tensor([0, 1, 2, 40, 1000], dtype=torch.int32).to(device)
    k = missed[torch.arange(n - first, device=device) % 5]
    steps = MissedSteps(k, None, 0.9, 0.999, 1e-15)
    decays = (steps.distance, steps.decay1, steps.decay2)
    missed_steps_map(*maps, *decays, rates=_RATES, eps=1e-15)
    return {
        f"{kind} {name}": column
        for kind, rows in zip(("param", "exp_avg", "exp_avg_sq"), whole, strict=True)
        for name, column in vars(rows).items()
    }
