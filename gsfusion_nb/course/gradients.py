"""A gradient written by hand, compared with autograd and with finite differences."""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

TOLERANCE = 1e-5
"""Largest difference that counts as agreement in float64, as a share of the largest number."""
_SHOWN = 3


@dataclass(frozen=True, eq=False)
class Compared:
    """The three gradients with respect to one input."""

    name: str
    hand: Tensor
    autograd: Tensor
    difference: Tensor

    @property
    def errors(self) -> tuple[float, float]:
        """Largest deviation of the hand-written one from autograd and differences, as a share of
        the largest number."""
        scale = (
            float(self.difference.abs().max().clamp_min(1e-12)) if self.difference.numel() else 1.0
        )
        return tuple(
            float((self.hand - other).abs().max()) / scale
            for other in (self.autograd, self.difference)
        )  # pyright: ignore[reportReturnType]


class GradientComparison:
    """The table that ``compare_gradients`` makes; ``ok`` says whether all three agree."""

    def __init__(self, rows: list[Compared]):
        self.rows = rows

    @property
    def ok(self) -> bool:
        """Whether the hand-written gradient agrees with both others for all inputs."""
        return all(max(row.errors) < TOLERANCE for row in self.rows)

    def __bool__(self) -> bool:
        return self.ok

    def __repr__(self) -> str:
        lines = [f"{'gradient by':>16} {'by hand':>12} {'autograd':>12} {'difference':>12}"]
        for row in self.rows:
            for name, *values in _numbers(row):
                lines.append(f"{name:>16} " + " ".join(f"{v:>12.6f}" for v in values))
            a, d = row.errors
            lines.append(
                f"{'':>16} largest error of {row.hand.numel()}: autograd {a:.0e}, difference "
                f"{d:.0e}"
            )
        return "\n".join([*lines, "all three agree" if self.ok else "they do NOT agree"])


def compare_gradients(
    forward: Callable[..., Tensor],
    vjp: Callable[..., Tensor | tuple[Tensor, ...]],
    inputs: dict[str, Tensor],
    *,
    v: Tensor | None = None,
    step: float = 1e-6,
) -> GradientComparison:
    """Compare a hand-written gradient with autograd and with central differences.

    The scalar is L = sum(v * forward(*inputs)): with a random ``v`` all outputs are tested at once.

    Args:
        forward: Plain torch.
        vjp: ``vjp(v, *inputs)`` returns dL/d of each input, in order.
        inputs: Name -> value; float64.
        v: dL/d of the output; random numbers, the same each time, by default.
        step: Step of the central differences.
    """
    values = {name: x.detach().clone().double().requires_grad_() for name, x in inputs.items()}
    output = forward(*values.values())
    if v is None:
        v = torch.randn(
            output.shape,
            generator=torch.Generator().manual_seed(0),
            dtype=torch.float64,
        )
    auto = torch.autograd.grad(
        (v * output).sum(),
        list(values.values()),
        allow_unused=True,
    )
    plain = [x.detach() for x in values.values()]
    with torch.no_grad():
        by_hand = vjp(v, *plain)
        hands = (by_hand,) if isinstance(by_hand, Tensor) else by_hand
        rows = []
        for i, (name, x) in enumerate(zip(inputs, plain, strict=True)):

            def loss(value: Tensor, i: int = i) -> float:
                return float((v * forward(*plain[:i], value, *plain[i + 1 :])).sum())

            numeric = central_difference(loss, x, step)
            from_graph = torch.zeros_like(x) if auto[i] is None else auto[i]
            rows.append(Compared(name, hands[i].double(), from_graph, numeric))
    return GradientComparison(rows)


def central_difference(
    loss: Callable[[Tensor], float],
    x: Tensor,
    step: float,
) -> Tensor:
    """(L(x + h) - L(x - h)) / 2h for every element of ``x``, one at a time. Two evaluations per
    number."""
    gradient = torch.zeros_like(x)
    for i in range(x.numel()):
        ends = []
        for sign in (1, -1):
            neighbour = x.clone()
            neighbour.view(-1)[i] += sign * step
            ends.append(loss(neighbour))
        gradient.view(-1)[i] = (ends[0] - ends[1]) / (2 * step)
    return gradient


def _numbers(row: Compared) -> list[tuple[str, float, float, float]]:
    """The first numbers of a row: name with index, and the three values."""
    shape = row.hand.shape
    table = []
    for i in range(min(row.hand.numel(), _SHOWN)):
        index = [int(j) for j in torch.unravel_index(torch.tensor(i), shape)] if shape else []
        name = row.name + (str(index) if index else "")
        table.append(
            (name, *(float(x.reshape(-1)[i]) for x in (row.hand, row.autograd, row.difference)))
        )
    return table
