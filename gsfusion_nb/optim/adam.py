"""Adam on a map that grows while it is optimised (``adam_step``), and on a fixed set of its rows
(``RowAdam``)."""

import contextlib
import math
from collections.abc import Callable, Iterator, Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from ..backends import observed, op
from ..checks import check_number
from ..config import OptimConfig
from ..errors import ArgumentError
from ..gaussians import GaussianModel, StepClock
from ..geometry.operands import INTEGERS, check_gaussians, check_operand
from ..render import Boxes
from ..types import GaussianParams

_NOTHING_LEFT = 8e-10
"""With zero gradient a row has stopped when its step is this share of the first: after 200 steps at
the usual decays, since (0.9 / sqrt(0.999))^200 is 8e-10."""

_ROWS_AT_A_TIME = 1 << 16
"""Of a map whose missed steps are taken in a copy, which limits the memory."""

BETA1 = 0.9
BETA2 = 0.999
EPS = 1e-15
"""Of ``RowAdam``: the values of the released code of RTG-SLAM, which are those of 3D Gaussian
splatting."""

UpdateFunction = Callable[..., None]
"""``update(param, gradient, m, v, steps, *, lr)``: an optimiser that is given to a mapper in place
of Adam.

It changes one column of the map in place: ``param`` [N, ...], and ``m`` and ``v`` of the same
shape. These two are its memory: they begin at zero, follow each row when rows are added and
removed, and are saved in checkpoints. ``steps`` [N] counts the steps of each row, this one
included. ``lr`` is the learning rate of the settings, a number or a tensor that fits a row."""


def check_adam(
    param: Any,
    gradient: Any,
    exp_avg: Any,
    exp_avg_sq: Any,
    steps: Any,
    *,
    lr: Any,
    **decay: float,
) -> None:
    """Raise ``ValueError`` for arguments that ``adam_update`` refuses."""
    check_operand(
        "param",
        param,
        ("N", *("W",) * (getattr(param, "ndim", 1) - 1)),
    )
    for name, value in {"gradient": gradient, "exp_avg": exp_avg, "exp_avg_sq": exp_avg_sq}.items():
        check_operand(
            name,
            value,
            tuple(param.shape),
            dtypes=(param.dtype,),
            device=param.device,
        )
    if isinstance(lr, Tensor):
        check_operand(
            "lr",
            lr,
            tuple(param.shape[1:]),
            device=None if lr.device.type == "cpu" else param.device,
        )
    else:
        check_number("lr", lr)
    _check_steps_and_decay(steps, param, decay)


def _check_steps_and_decay(steps: Any, param: Tensor, decay: Mapping[str, float]) -> None:
    if isinstance(steps, Tensor):
        check_operand("steps", steps, (len(param),), dtypes=INTEGERS, device=param.device)
    elif steps is not None:
        check_number("steps", steps, 1)
    check_number("eps", decay["eps"], 0.0)
    for name in ("beta1", "beta2"):
        check_number(name, decay[name], 0.0, 1.0)


@op("adam", check_adam)
def adam_update(
    param: Float[Tensor, "N *W"],
    gradient: Float[Tensor, "N *W"],
    exp_avg: Float[Tensor, "N *W"],
    exp_avg_sq: Float[Tensor, "N *W"],
    steps: int | Int[Tensor, " N"] | None,
    *,
    lr: float | Float[Tensor, "*W"],
    beta1: float,
    beta2: float,
    eps: float,
) -> None:
    """One step of Adam, in place on ``param``, ``exp_avg`` and ``exp_avg_sq``.

        m <- b1 m + (1 - b1) g,   v <- b2 v + (1 - b2) g^2
        param <- param - lr (m / (1 - b1^t)) / (sqrt(v / (1 - b2^t)) + eps)

    Args:
        param: Values to update. [N, ...]
        gradient: dL/dparam. [N, ...]
        exp_avg: m. [N, ...]
        exp_avg_sq: v. [N, ...]
        steps: t, including this step: one number for all rows, or one per row [N]. None: no bias
            correction.
        lr: Learning rate, in units of the parameter: one number, or one for each value of a row.
            [...]
        beta1: Decay of m.
        beta2: Decay of v.
        eps: Keeps the division finite where v = 0.

    Rows that no pixel sees have zero gradient, but their momentum still moves them, as in the
    released GSFusion. Those that the view cannot show are left out (``PartOfMap``) and catch up
    when they are seen (``take_missed_steps``).

    Source: Kingma & Ba 2015, algorithm 1.
    """
    m = beta1 * exp_avg + (1 - beta1) * gradient
    v = beta2 * exp_avg_sq + (1 - beta2) * gradient**2
    m_hat = m / _bias(beta1, steps, m)
    v_hat = v / _bias(beta2, steps, v)
    param.copy_(param - lr * m_hat / (v_hat.sqrt() + eps))
    exp_avg.copy_(m)
    exp_avg_sq.copy_(v)


def _bias(beta: float, steps: int | Tensor | None, moment: Tensor) -> float | Tensor:
    """1 - beta^t: the share of its weights that a moment has which began at 0; 1 without a
    correction."""
    if not isinstance(steps, Tensor):
        return 1.0 if steps is None else 1 - beta**steps
    # float64: 1 - b2^t would lose its digits in float32
    t = steps.double().reshape(-1, *[1] * (moment.ndim - 1))
    return (1 - beta**t).to(moment)


class ColumnRates(NamedTuple):
    """Learning rate of each column of a map, in units of the parameter."""

    xyz_W: float
    log_scale: float
    quat: float
    opacity_logit: float
    sh_dc: float
    """Of SH coefficient 0."""
    sh_rest: float
    """Of the other SH coefficients."""

    def by_column(self, sh: Float[Tensor, "N K 3"]) -> dict[str, float | Tensor]:
        """The same as ``adam_update`` takes it: one number, and for ``sh`` one for each
        coefficient. [K, 3]"""
        sh_rates = sh.new_full((sh.shape[1], 1), self.sh_rest)
        sh_rates[0] = self.sh_dc
        return {
            "xyz_W": self.xyz_W,
            "log_scale": self.log_scale,
            "quat": self.quat,
            "opacity_logit": self.opacity_logit,
            "sh": sh_rates.expand(-1, 3),
        }


def check_adam_map(
    params: Any,
    gradients: Any,
    exp_avg: Any,
    exp_avg_sq: Any,
    steps: Any,
    *,
    rates: Any,
    **decay: float,
) -> None:
    """Raise ``ValueError`` for arguments that ``adam_update_map`` refuses."""
    check_gaussians(params)
    for name, rows in {
        "gradients": gradients,
        "exp_avg": exp_avg,
        "exp_avg_sq": exp_avg_sq,
    }.items():
        try:
            check_gaussians(rows, like=params)
        except ValueError as e:
            raise ArgumentError(f"{name}.{e}") from None
    if not isinstance(rates, ColumnRates):
        raise ArgumentError(f"rates must be ColumnRates, got {type(rates).__name__}")
    for name, rate in rates._asdict().items():
        check_number(f"rates.{name}", rate)
    _check_steps_and_decay(steps, params.xyz_W, decay)


@op("adam", check_adam_map)
def adam_update_map(
    params: GaussianParams,
    gradients: GaussianParams,
    exp_avg: GaussianParams,
    exp_avg_sq: GaussianParams,
    steps: int | Int[Tensor, " N"] | None,
    *,
    rates: ColumnRates,
    beta1: float,
    beta2: float,
    eps: float,
) -> None:
    """``adam_update`` of every column of a map, each at its own learning rate.

    Args:
        params: Values to update, in place.
        gradients: dL/dparams.
        exp_avg: m of each value, updated in place.
        exp_avg_sq: v of each value, updated in place.
        steps: t, including this step: one number for all rows, or one per row [N]. None: no bias
            correction.
        rates: Learning rates.
        beta1: Decay of m.
        beta2: Decay of v.
        eps: Keeps the division finite where v = 0.

    Source: Kingma & Ba 2015, algorithm 1.
    """
    for name, lr in rates.by_column(params.sh).items():
        p, g, m, v = (getattr(rows, name) for rows in (params, gradients, exp_avg, exp_avg_sq))
        adam_update(
            p,
            g,
            m,
            v,
            steps,
            lr=lr,
            beta1=beta1,
            beta2=beta2,
            eps=eps,
        )


class PartOfMap:
    """Copies of some rows of a map and of their moments, for ``adam_step``; ``write_back`` puts
    them into the map.

    The rows that are left out keep their values and their moments until ``take_missed_steps``.

    Args:
        model: The map.
        rows: Some of its rows, each once. [R]
        boxes: Those of the map, from which the rows are.
    """

    def __init__(self, model: GaussianModel, rows: Int[Tensor, " R"], boxes: Boxes):
        self.model = model
        self.rows = rows
        self._boxes = boxes
        self.params, self.exp_avg, self.exp_avg_sq = (
            x[rows] for x in (model.params, model.exp_avg, model.exp_avg_sq)
        )
        self.clock = model.clock.part(rows)
        self.rates = {name: factors[rows] for name, factors in model.rates.items()}
        self._state = model.state_of_columns()

    @property
    def step_count(self) -> int:
        """Steps of the map, with those on the part."""
        return self.clock.count

    @property
    def birth_step(self) -> Int[Tensor, " R"]:
        """Value of ``step_count`` when each row was added, or its moments were forgotten."""
        return self.clock.birth

    @property
    def is_current(self) -> bool:
        """Whether the map has not changed since the rows were copied or written back."""
        return self._state == self.model.state_of_columns()

    def write_back(self) -> None:
        """Copy parameters, moments and the number of steps to the map."""
        for name in ("params", "exp_avg", "exp_avg_sq"):
            for column, values in vars(getattr(self, name)).items():
                getattr(getattr(self.model, name), column).index_copy_(0, self.rows, values)
        self.model.clock.write_back(self.rows, self.clock)
        self._boxes.renew(self.model.params, self.rows, self.params)
        self._state = self.model.state_of_columns()


@observed
def adam_step(
    model: GaussianModel | PartOfMap,
    gradients: GaussianParams,
    config: OptimConfig,
    update: UpdateFunction | None = None,
) -> None:
    """Update every parameter of the map once, each group at its own constant learning rate.

    The bias correction multiplies a step by sqrt(1 - b2^t) / (1 - b1^t). ``config.adam_steps`` says
    what t is:

    - ``"per_row"``: the age of each Gaussian (textbook Adam). Its first step is one learning rate.
    - ``"none"``: no correction. Where the gradient stays the same, the first step of a new Gaussian
      is (1 - 0.9) / sqrt(1 - 0.999) = 3.16 learning rates and its tenth 6.5.
    - ``"shared"``: the number of steps of the whole map, as in the released GSFusion. Every
      Gaussian of the map, new or old, then takes the step of ``"none"`` times the same factor: 0.15
      at step 10, 0.44 at 210, 0.93 at 2,000. In a short run all Gaussians learn more slowly; at the
      16,000 steps of a Replica sequence there is no difference left.

    Where the map has factors of learning rates (``model.rates``), each row takes its own part of
    the step.

    Args:
        model: The map, or a part of it, changed in place.
        gradients: dL/d of its parameters.
        config: Learning rates and decays.
        update: Takes the step of each column instead of ``adam_update``.

    Raises:
        ValueError: ``update`` made a parameter NaN or infinite that was finite.
    """
    t = model.step_count + 1
    steps: int | Tensor | None = {"none": None, "shared": t}.get(config.adam_steps)
    if config.adam_steps == "per_row":
        steps = t - model.birth_step
    rates = _rates_of(config)
    m = model.exp_avg
    v = model.exp_avg_sq
    with at_row_rates(model.params, model.rates):
        if update is None:
            decay = {"beta1": config.beta1, "beta2": config.beta2, "eps": config.eps}
            adam_update_map(model.params, gradients, m, v, steps, rates=rates, **decay)
        else:
            ages = t - model.birth_step
            for name, lr in rates.by_column(model.params.sh).items():
                p, g, m_, v_ = (getattr(rows, name) for rows in (model.params, gradients, m, v))
                take_step(update, name, p, g, m_, v_, ages, lr)
    model.clock.step()


def _rates_of(config: OptimConfig) -> ColumnRates:
    return ColumnRates(
        xyz_W=config.lr_xyz,
        log_scale=config.lr_log_scale,
        quat=config.lr_quat,
        opacity_logit=config.lr_opacity_logit,
        sh_dc=config.lr_sh_dc,
        sh_rest=config.lr_sh_rest,
    )


def take_missed_steps(model: GaussianModel | PartOfMap, config: OptimConfig) -> None:
    """Move the rows by the steps of Adam that they missed while no view showed them: steps with
    zero gradient.

    In each of them  m <- b1 m,  v <- b2 v,  so k steps together are a geometric series, with  r =
    b1 / sqrt(b2):

        param <- param - lr m / (sqrt(v) + eps) sum_{j=1..k} c_j r^j,   m <- b1^k m,   v <- b2^k v

    c_j is the bias correction  sqrt(1 - b2^t) / (1 - b1^t)  of the j-th missed step, or 1 without
    one. This is ``adam_step`` on the whole map but for rounding and for eps, which is 1e-15 beside
    sqrt(v).

    Args:
        model: The map, or a part of it, changed in place.
        config: Learning rates and decays.
    """
    clock = model.clock
    missed = clock.missed
    if not bool(missed.any()):
        return
    start = {"none": None, "shared": clock.last, "per_row": clock.age_at_last}[config.adam_steps]
    steps = MissedSteps(missed, start, config.beta1, config.beta2, config.eps)
    for name, lr in _rates_of(config).by_column(model.params.sh).items():
        column, m, v = (
            getattr(values, name) for values in (model.params, model.exp_avg, model.exp_avg_sq)
        )
        steps.take(column, m, v, lr, model.rates.get(name))
    clock.catch_up()


def params_now(
    model: GaussianModel, config: OptimConfig, rows: Int[Tensor, " R"] | None = None
) -> GaussianParams:
    """Parameters of a map as they are with the steps that rows missed; the map does not change.

    Args:
        model: The map.
        config: Learning rates and decays of its steps.
        rows: Some of its rows, each once; None: all. [R]

    Returns:
        A copy, or the map's own tensors if all rows are asked for and none misses a step.
    """
    params = model.params if rows is None else model.params[rows]
    missed = model.clock.missed if rows is None else model.clock.missed[rows]
    late = missed.nonzero()[:, 0]
    if not len(late):
        return params
    if rows is None:
        params = GaussianParams(**{name: column.clone() for name, column in vars(params).items()})
    for places in late.split(_ROWS_AT_A_TIME):
        part = PartOfMap(model, places if rows is None else rows[places], Boxes())
        take_missed_steps(part, config)
        for name, values in vars(part.params).items():
            getattr(params, name)[places] = values
    return params


class MissedSteps:
    """The steps of ``take_missed_steps``, for one column of the map after another; a row with k = 0
    stays as it is.

    Args:
        missed: k of each row. [R]
        start: t of the step before the first missed one; None: without bias correction. [R]
        beta1, beta2, eps: As for ``adam_update``.
    """

    def __init__(
        self,
        missed: Int[Tensor, " R"],
        start: Int[Tensor, " R"] | None,
        beta1: float,
        beta2: float,
        eps: float,
    ):
        self.eps = eps
        ratio = beta1 / math.sqrt(beta2)
        self.decay1, self.decay2 = (beta ** missed.double() for beta in (beta1, beta2))
        if start is None:
            self.distance = ratio * (1 - ratio ** missed.double()) / (1 - ratio)
        else:  # rows that were seen together share their sum
            enough = math.ceil(math.log(_NOTHING_LEFT) / math.log(ratio)) if ratio else 1
            k = missed.clamp_max(enough)
            pairs, which = torch.unique(start.long() * (enough + 1) + k, return_inverse=True)
            first = pairs[:, None] // (enough + 1)
            last = pairs[:, None] % (enough + 1)
            j = torch.arange(
                1,
                int(k.max()) + 1,
                device=k.device,
            )
            t = (first + j).double()
            terms = (1 - beta2**t).sqrt() / (1 - beta1**t) * ratio**j
            self.distance = (terms * (j <= last)).sum(1)[which]

    def take(
        self,
        column: Tensor,
        m: Tensor,
        v: Tensor,
        lr: float | Tensor,
        factor: Tensor | None,
    ) -> None:
        """Change a column and its moments in place; ``factor`` of the learning rate is one for each
        row."""
        distance = self.distance if factor is None else self.distance * factor
        far, decay1, decay2 = (
            x.to(m).view(-1, *[1] * (m.ndim - 1)) for x in (distance, self.decay1, self.decay2)
        )
        column -= lr * far * m / (v.sqrt() + self.eps)
        m *= decay1
        v *= decay2


def take_step(
    update: UpdateFunction,
    name: str,
    param: Tensor,
    gradient: Tensor,
    m: Tensor,
    v: Tensor,
    ages: Tensor,
    lr: Any,
) -> None:
    """One step of an optimiser from outside on the column ``name``; arguments as for
    ``UpdateFunction``.

    Raises:
        ValueError: a value is no longer finite that was before.
    """
    finite = param.isfinite()
    update(param, gradient, m, v, ages, lr=lr)
    if lost := int((finite & ~param.isfinite()).sum()):
        raise ArgumentError(
            f"the optimiser made {lost} values of {name} NaN or infinite; try smaller learning "
            "rates"
        )


@contextlib.contextmanager
def at_row_rates(
    params: GaussianParams, factors: Mapping[str, Float[Tensor, " N"]]
) -> Iterator[None]:
    """Context in which one step of Adam is taken, which then moves each row by ``factors`` times as
    far.

    The step of Adam is its learning rate times a direction that does not depend on it, so a factor
    of the step is the same factor of the learning rate. With factor 0 the row keeps its values bit
    for bit, with 1 it takes the step bit for bit. Adam's moments change as usual, also those of
    frozen rows.

    Args:
        params: What the step changes in place.
        factors: Parameter -> factor of each row, at least 0; a parameter that is missing takes its
            whole step.
    """
    before = {name: getattr(params, name).clone() for name in factors}
    yield
    for name, start in before.items():
        value = getattr(params, name)
        factor = factors[name].reshape(-1, *[1] * (value.ndim - 1)).to(value)
        value.copy_(
            torch.where(
                factor == 0,
                start,
                torch.lerp(start, value, factor),
            )
        )


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
