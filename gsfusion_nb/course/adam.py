"""Adam, written by hand: an exercise of chapter 5."""

import math

import torch
from torch import Tensor

from .exercise import Attempt, Becomes, Wrong, Yours, exercise

Step = tuple[Tensor, Tensor, Tensor]


def _adam(param, gradient, m, v, t, lr, beta1, beta2, eps) -> Step:
    m = beta1 * m + (1 - beta1) * gradient
    v = beta2 * v + (1 - beta2) * gradient**2
    m_hat = m / (1 - beta1**t)
    v_hat = v / (1 - beta2**t)
    return param - lr * m_hat / (v_hat.sqrt() + eps), m, v


def _uncorrected(param, gradient, m, v, t, lr, beta1, beta2, eps) -> Step:
    return _adam(param, gradient, m, v, math.inf, lr, beta1, beta2, eps)


def _uphill(param, gradient, m, v, t, lr, beta1, beta2, eps) -> Step:
    return _adam(param, gradient, m, v, t, -lr, beta1, beta2, eps)


def _not_squared(param, gradient, m, v, t, lr, beta1, beta2, eps) -> Step:
    m = beta1 * m + (1 - beta1) * gradient
    v = beta2 * v + (1 - beta2) * gradient.abs()
    return param - lr * m / (1 - beta1**t) / ((v / (1 - beta2**t)).sqrt() + eps), m, v


def _no_memory(param, gradient, m, v, t, lr, beta1, beta2, eps) -> Step:
    return param - lr * gradient / (gradient.abs() + eps), gradient, gradient**2


def _corrected_moments_kept(param, gradient, m, v, t, lr, beta1, beta2, eps) -> Step:
    param, m, v = _adam(
        param,
        gradient,
        m,
        v,
        t,
        lr,
        beta1,
        beta2,
        eps,
    )
    return param, m / (1 - beta1**t), v / (1 - beta2**t)


def _eps_inside(param, gradient, m, v, t, lr, beta1, beta2, eps) -> Step:
    _, m, v = _adam(
        param,
        gradient,
        m,
        v,
        t,
        lr,
        beta1,
        beta2,
        eps,
    )
    return param - lr * m / (1 - beta1**t) / (v / (1 - beta2**t) + eps).sqrt(), m, v


def _as_adam_update(
    yours: Yours,
    param: Tensor,
    gradient: Tensor,
    exp_avg: Tensor,
    exp_avg_sq: Tensor,
    steps: int | Tensor | None,
    *,
    lr: float | Tensor,
    beta1: float,
    beta2: float,
    eps: float,
) -> None:
    """Yours on all rows that have taken the same number of steps, in place."""
    if isinstance(steps, Tensor):
        parts = [(int(t), steps == t) for t in steps.unique()]
    else:
        parts = [
            (
                math.inf if steps is None else steps,
                torch.ones(len(param), dtype=torch.bool, device=param.device),
            )
        ]
    state = {"param": param, "m": exp_avg, "v": exp_avg_sq}
    for t, rows in parts:
        p, g, m, v = (x[rows] for x in (param, gradient, exp_avg, exp_avg_sq))
        new = yours(
            p,
            g,
            m,
            v,
            t,
            lr,
            beta1,
            beta2,
            eps,
            gives={"param": p, "m": m, "v": v},
        )
        for old, value in zip(state.values(), new, strict=True):
            old[rows] = value


@exercise(
    chapter=5,
    difficulty=3,
    minutes=12,
    solution=_adam,
    becomes=Becomes("adam_update", _as_adam_update),
    hints=(
        "First the two running averages: m of the gradient, v of its square. What weight does the "
        "new value get?",
        "Both start at 0 and are too small at first: divide m by 1 - beta1^t, and v by 1 - "
        "beta2^t.",
        "Go downhill by lr m_hat / (sqrt(v_hat) + eps). Return m and v without the correction; the "
        "next step needs them. beta ** t is 0 for t = infinity, so no special case is needed.",
    ),
    wrong=(
        Wrong(_uphill, says="a positive gradient makes the parameter smaller"),
        Wrong(_uncorrected, says="the first step is one learning rate"),
        Wrong(_not_squared, says="v averages the squared gradient"),
        Wrong(_no_memory, says="m averages the gradient"),
        Wrong(_corrected_moments_kept, says="without the correction"),
        Wrong(_eps_inside, says="eps is added to the root"),
    ),
)
def adam(attempt: Attempt) -> None:
    """One step of Adam (Kingma & Ba 2015): new parameter, m and v."""
    names = ("param", "m", "v")
    f64 = torch.float64
    rest = (0.01, 0.9, 0.999, 1e-15)
    zero = torch.zeros(2, 1, dtype=f64)
    g = torch.tensor([[2.0], [-0.5]], dtype=f64)
    attempt.on("gradients 2 and -0.5 at the first step, lr = 0.01")
    param, m, v = attempt.unpack(attempt(zero, g, zero, zero, 1, *rest), names)
    attempt.close(
        m,
        0.1 * g,
        "m averages the gradient: a new value counts 1 - beta1",
        why="returned without the correction",
    )
    attempt.close(v, 0.001 * g**2, "v averages the squared gradient, without the correction")
    attempt.signs(param, [[-1.0], [1.0]], "a positive gradient makes the parameter smaller")
    why = "m_hat / sqrt(v_hat) is the sign of the gradient at t = 1"
    attempt.close(
        param,
        [[-0.01], [0.01]],
        "the first step is one learning rate, however large the gradient",
        why=why,
    )
    generator = torch.Generator().manual_seed(4)
    param, g, m = (torch.randn(5, 3, generator=generator, dtype=f64) for _ in range(3))
    v = torch.rand(5, 3, generator=generator, dtype=f64)
    lr = torch.tensor([0.1, 0.2, 0.3], dtype=f64)
    inputs = (param, g, m, v)
    got = attempt.unpack(
        attempt.on("random numbers at step 7, lr = 0.05")(*inputs, 7, 0.05, 0.9, 0.99, 1e-15), names
    )
    reference = _adam(*inputs, 7, 0.05, 0.9, 0.99, 1e-15)
    attempt.close(got[1], reference[1], "m averages the gradient: the old m counts beta1")
    attempt.close(got[2], reference[2], "v averages the squared gradient: the old v counts beta2")
    unbiased = (
        "the step is lr m_hat / sqrt(v_hat), with m_hat = m / (1 - beta1^t) and v_hat = v "
        "/ (1 - beta2^t)"
    )
    attempt.close(got[0], reference[0], unbiased)
    got = attempt.unpack(
        attempt.on("the same with eps = 0.1")(*inputs, 7, 0.05, 0.9, 0.99, 0.1), names
    )
    attempt.close(
        got[0],
        _adam(*inputs, 7, 0.05, 0.9, 0.99, 0.1)[0],
        "eps is added to the root of v_hat",
    )
    attempt.on("the same with a learning rate for each column")
    got = attempt.unpack(attempt(*inputs, 7, lr, 0.9, 0.99, 0.1), names)
    attempt.close(
        got[0],
        _adam(*inputs, 7, lr, 0.9, 0.99, 0.1)[0],
        "lr may be a tensor, one for each column",
    )
    attempt.on("the same with t = infinity: no correction")
    got = attempt.unpack(attempt(*inputs, math.inf, lr, 0.9, 0.999, 0.1), names)
    reference = _adam(*inputs, math.inf, lr, 0.9, 0.999, 0.1)
    attempt.close(got[0], reference[0], "for t = infinity nothing is corrected")
