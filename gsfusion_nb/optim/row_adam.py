"""Adam on a fixed set of Gaussians, for one optimisation window or for the end of a scan."""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import torch
from jaxtyping import Int
from torch import Tensor

from ..checks import check_saved, check_whole
from ..observing import observed
from ..types import GaussianParams
from .adam import adam_update
from .row_rates import at_row_rates

BETA1, BETA2, EPS = 0.9, 0.999, 1e-15


class RowAdam:
    """Moments that start at zero, bias correction by the number of steps taken, one constant rate per group.

    Args:
        params: Parameters to update, in place.
        rates: Learning rate of each group: xyz_W, log_scale, quat, sh_dc, sh_rest. Groups with rate 0 do not change;
            opacity never changes (Peng et al. 2024: lr_alpha = 0).
        factors: Parameter -> factor of its rate for each row [N]; those that are missing are 1.
    """

    def __init__(
        self, params: GaussianParams, rates: Mapping[str, float], factors: Mapping[str, Tensor] = MappingProxyType({})
    ):
        self.params = params
        self._factors = factors
        self.steps = 0
        sh_rates = params.sh.new_full((params.sh.shape[1], 1), rates["sh_rest"])
        sh_rates[0] = rates["sh_dc"]
        self._rates: dict[str, Any] = {
            name: rates[name] for name in ("xyz_W", "log_scale", "quat") if rates[name] > 0
        } | {"sh": sh_rates.expand(-1, 3)}
        self._moments = {name: [torch.zeros_like(getattr(params, name)) for _ in range(2)] for name in self._rates}

    @observed
    def step(self, gradients: GaussianParams) -> None:
        """Update once. Rows of ``gradients`` beyond those of ``params`` are ignored."""
        self.steps += 1
        n = len(self.params)
        with at_row_rates(self.params, self._factors):
            for name, lr in self._rates.items():
                m, v = self._moments[name]
                gradient = getattr(gradients, name)[:n]
                adam_update(
                    getattr(self.params, name), gradient, m, v, self.steps, lr=lr, beta1=BETA1, beta2=BETA2, eps=EPS
                )

    def take_over(self, earlier: "RowAdam", before: Int[Tensor, " N"]) -> None:
        """Continue with the moments and the step count of other rows; ``before`` is the row there of each, or -1."""
        self.steps, known = earlier.steps, before >= 0
        for name, moments in self._moments.items():
            for mine, theirs in zip(moments, earlier._moments[name], strict=True):
                mine[known] = theirs[before[known]]

    def state_dict(self) -> dict[str, Any]:
        """Moments and step count."""
        moments = {name: [moment.clone() for moment in pair] for name, pair in self._moments.items()}
        return {"steps": self.steps, "moments": moments}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what ``state_dict`` saved. Raises ``ValueError`` for moments of parameters of another shape."""
        check_whole("steps", state["steps"], 0)
        self.steps = state["steps"]
        if set(state["moments"]) != set(self._moments):
            raise ValueError(f"moments must be of {sorted(self._moments)}, got {sorted(state['moments'])}")
        for name, moments in state["moments"].items():
            for mine, saved in zip(self._moments[name], moments, strict=True):
                check_saved(f"moment of {name}", saved, tuple(mine.shape), mine.dtype, finite=False)
                mine.copy_(saved)
