"""Adam on a fixed set of rows, which forgets its moments when they are done (RTG-SLAM)."""

from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any

import torch
from jaxtyping import Int
from torch import Tensor

from ..gaussians import StepClock
from ..types import GaussianParams
from .adam import adam_update
from .map_step import UpdateFunction, at_row_rates, take_step
from .missed_steps import MissedSteps

BETA1 = 0.9
BETA2 = 0.999
EPS = 1e-15
"""Of ``RowAdam``: the values of the released code of RTG-SLAM, which are those of 3D Gaussian
splatting."""


class RowAdam:
    """Moments that start at zero, bias correction by the number of steps taken, one constant rate
    per group.

    Args:
        params: Parameters to update, in place.
        rates: Learning rate of each group: xyz_W, log_scale, quat, sh_dc, sh_rest. Groups with rate
            0 do not change; opacity never changes (Peng et al. 2024: lr_alpha = 0).
        factors: Parameter -> factor of its rate for each row [N]; those that are missing are 1.
        update: Takes the step of each group instead of ``adam_update``.
    """

    def __init__(
        self,
        params: GaussianParams,
        rates: Mapping[str, float],
        factors: Mapping[str, Tensor] = MappingProxyType({}),
        update: UpdateFunction | None = None,
    ):
        self.params = params
        self._update = update
        self._factors = factors
        sh_rates = params.sh.new_full((params.sh.shape[1], 1), rates["sh_rest"])
        sh_rates[0] = rates["sh_dc"]
        self._rates: dict[str, Any] = {
            name: rates[name] for name in ("xyz_W", "log_scale", "quat") if rates[name] > 0
        } | {"sh": sh_rates.expand(-1, 3)}
        self._moments = {
            name: [torch.zeros_like(getattr(params, name)) for _ in range(2)]
            for name in self._rates
        }
        self.clock = StepClock.of_new_rows(len(params), params.xyz_W.device)
        self._log: list[tuple[Any, dict[str, list[Tensor]]]] | None = None
        """Rows, and their parameters and moments, before each change since ``log_changes``."""

    def log_changes(self) -> Callable[[], None]:
        """From now on changes are kept, until ``end_log``. Returns a function that undoes them."""
        log = self._log = []
        clock = self.clock.copy()

        def undo() -> None:
            for rows, columns in reversed(log):
                for name, values in columns.items():
                    for column, before in zip(self._columns(name), values, strict=True):
                        column[rows] = before
            self.clock = clock

        return undo

    def end_log(self) -> None:
        """What changes from now on cannot be undone."""
        self._log = None

    def _columns(self, name: str) -> list[Tensor]:
        """A parameter and its moments."""
        return [getattr(self.params, name), *self._moments[name]]

    def _will_change(self, rows: Int[Tensor, " R"] | slice) -> None:
        if self._log is not None:
            self._log.append(
                (
                    rows,
                    {name: [c[rows].clone() for c in self._columns(name)] for name in self._rates},
                )
            )

    @property
    def steps(self) -> int:
        """Steps so far."""
        return self.clock.count

    def catch_up(self, rows: Int[Tensor, " R"]) -> None:
        """Take the steps that these rows missed, each with zero gradient, as ``take_missed_steps``
        does."""
        late, caught_up = self._caught_up(rows)
        if len(late):
            self._will_change(late)
        for name, columns in caught_up.items():
            for column, values in zip(self._columns(name), columns, strict=True):
                column[late] = values
        self.clock.catch_up(late)

    def params_now(self) -> GaussianParams:
        """A copy of the parameters as they are with the steps that rows missed."""
        params = GaussianParams(
            **{name: column.clone() for name, column in vars(self.params).items()}
        )
        late, caught_up = self._caught_up(torch.arange(len(params), device=params.xyz_W.device))
        for name, columns in caught_up.items():
            getattr(params, name)[late] = columns[0]
        return params

    def _caught_up(
        self, rows: Int[Tensor, " R"]
    ) -> tuple[Int[Tensor, " L"], dict[str, list[Tensor]]]:
        """Which of the rows missed steps of Adam, and copies of their parameters and moments after
        these steps."""
        late = rows[self.clock.missed[rows] > 0]
        if self._update is not None or not len(late):
            return late[:0], {}
        last = self.clock.last[late]
        steps = MissedSteps(self.steps - last, last, BETA1, BETA2, EPS)
        caught_up = {}
        for name, lr in self._rates.items():
            factor = self._factors.get(name)
            param, m, v = (column[late] for column in self._columns(name))
            steps.take(param, m, v, lr, None if factor is None else factor[late])
            caught_up[name] = [param, m, v]
        return late, caught_up

    def step(
        self,
        gradients: GaussianParams,
        rows: Int[Tensor, " R"] | None = None,
    ) -> None:
        """Update once.

        Args:
            gradients: Of ``params``, or of their ``rows``; further rows of it are ignored.
            rows: Update only these, each once; the others keep their values and moments
                (``catch_up``). None: all. [R]
        """
        self._will_change(slice(None) if rows is None else rows)
        self.clock.step(slice(None) if rows is None else rows)
        params = self.params if rows is None else self.params[rows]
        factors = (
            self._factors if rows is None else {name: f[rows] for name, f in self._factors.items()}
        )
        n = len(params)
        with at_row_rates(params, factors):
            for name, lr in self._rates.items():
                moments = self._moments[name]
                m, v = moments if rows is None else (moment[rows] for moment in moments)
                param = getattr(params, name)
                gradient = getattr(gradients, name)[:n]
                if self._update is None:
                    adam_update(
                        param,
                        gradient,
                        m,
                        v,
                        self.steps,
                        lr=lr,
                        beta1=BETA1,
                        beta2=BETA2,
                        eps=EPS,
                    )
                else:
                    ages = torch.full((n,), self.steps, device=param.device)
                    take_step(self._update, name, param, gradient, m, v, ages, lr)
                if rows is not None:
                    for whole, part in zip(moments, (m, v), strict=True):
                        whole.index_copy_(0, rows, part)
        if rows is not None:
            for name in self._rates:
                getattr(self.params, name).index_copy_(0, rows, getattr(params, name))

    def take_over(self, earlier: "RowAdam", before: Int[Tensor, " N"]) -> None:
        """Continue with the moments and the step count of other rows; ``before`` is the row there
        of each, or -1."""
        known = before >= 0
        self.clock.advance(earlier.steps)
        self.clock.last[known] = earlier.clock.last[before[known]]
        for name, moments in self._moments.items():
            for mine, theirs in zip(moments, earlier._moments[name], strict=True):
                mine[known] = theirs[before[known]]

    def state_dict(self) -> dict[str, Any]:
        """Moments, and the number of steps, also of each row."""
        moments = {
            name: [moment.clone() for moment in pair] for name, pair in self._moments.items()
        }
        return {"steps": self.steps, "last": self.clock.last.clone(), "moments": moments}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what ``state_dict`` saved, for parameters of the same shape."""
        self.clock.advance(state["steps"])
        self.clock.last.copy_(state["last"])
        for name, moments in state["moments"].items():
            for mine, saved in zip(self._moments[name], moments, strict=True):
                mine.copy_(saved)
