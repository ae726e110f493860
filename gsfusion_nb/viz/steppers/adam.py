"""A stepper through Adam on a map that grows: moments, bias correction, and the step that each row takes."""

import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Literal

import torch

from ...config import OptimConfig
from ...drawing.curves import BETWEEN, PALETTE
from ...gaussians import GaussianModel
from ...optim import adam_step
from ...optim.adam import adam_update
from ...types import GaussianParams, Seeds
from .recording import Line, Recording, record
from .stepper import Step, Stepper, style, text_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Count = Literal["per_row", "shared", "none"]
COUNTS: tuple[Count, ...] = ("per_row", "shared", "none")
WATCH = {
    adam_update: {
        "adam_step": ("t", "steps", "model.birth_step"),
        "adam_update": ("param", "gradient", "exp_avg", "exp_avg_sq", "m", "v", "steps", "m_hat", "v_hat", "lr"),
    },
    GaussianModel: {"append": ("start", "stop")},
}


def record_adam(
    gradient: Sequence[float | int], config: OptimConfig, *, before: int, after: int, earlier_steps: int = 0
) -> Recording:
    """``adam_step`` on a map whose last row is added after ``before`` steps: a recording.

    Only the opacities have a gradient, the same at every step: ``gradient[k]`` for row k.
    """
    model = GaussianModel(sh_degree=0)
    model.step_count = earlier_steps

    def seeds(n: int) -> Seeds:
        return Seeds.isotropic(torch.zeros(n, 3), torch.full((n, 3), 0.5), torch.full((n,), 0.1), opacity=0.5)

    def run() -> None:
        model.append(seeds(len(gradient) - 1))
        for k in range(before + after):
            if k == before:
                model.append(seeds(1))
            zero = {name: torch.zeros_like(value) for name, value in vars(model.params).items()}
            wanted = torch.tensor([float(g) for g in gradient[: len(model)]])
            adam_step(model, GaussianParams(**zero | {"opacity_logit": wanted}), config)

    return record(run, WATCH)


def adam_stepper(
    gradient: Sequence[float | int] = (0.3, -0.1, 0.3),
    *,
    adam_steps: Count = "per_row",
    before: int = 4,
    after: int = 5,
    earlier_steps: int = 0,
) -> Stepper:
    """Press Next through steps of Adam on a map to which a Gaussian is added in between.

    Shown are the opacities; the gradient of each row is the same at all steps. Above: the length of each step, in
    learning rates; the last row is orange, and its steps with the two other counts are dashed. Below: the values.

    Args:
        gradient: dL/d opacity_logit of each row; the last row is added later.
        adam_steps: What the bias correction counts, as in ``OptimConfig``.
        before: Steps before the last row is added.
        after: Steps after it.
        earlier_steps: Steps that the map took before these, for the shared count.

    Raises:
        ValueError: there are fewer than two rows, or no steps.
    """
    if len(gradient) < 2 or before < 1 or after < 1:
        raise ValueError("two rows or more, and at least one step before and after the last one is added, are needed")
    how = {"before": before, "after": after, "earlier_steps": earlier_steps}
    config = dataclasses.replace(OptimConfig(), adam_steps=adam_steps)
    lengths = {
        name: _lengths(record_adam(gradient, dataclasses.replace(config, adam_steps=name), **how)) for name in COUNTS
    }
    steps = _steps(record_adam(gradient, config, **how), len(gradient), adam_steps)
    others = {name: lengths[name][before:] for name in COUNTS if name != adam_steps}
    build = lambda figure: _picture(figure, steps, others, before)  # noqa: E731
    first = next(i for i, step in enumerate(steps) if step.title.startswith("A new row"))
    return Stepper(
        steps, build, name="adam", label=f"Adam on a growing map, count {adam_steps}", size=(450, 360),
        stills=(4, min(first + 4, len(steps) - 1), len(steps) - 1),
    )  # fmt: skip


def _of_opacity(recording: Recording, part: str) -> list[Line]:
    """The lines of ``adam_update`` that belong to the opacities, the only column of one number per row."""
    return [line for line in recording.at(part) if line["param"].ndim == 1]


def _lengths(recording: Recording) -> list[float]:
    """Length of each step of the last row that there is, in learning rates."""
    before, after = _of_opacity(recording, "m = beta1 *"), _of_opacity(recording, "param.copy_(")
    return [float((b["param"] - a["param"]).abs()[-1] / a["lr"]) for a, b in zip(before, after, strict=True)]


def _steps(recording: Recording, rows: int, adam_steps: Count) -> list[Step]:
    steps: list[Step] = []
    history: list[list[tuple[int, float, float]]] = [[] for _ in range(rows)]
    now, start = 0, torch.zeros(0)
    counting = "steps = t - model.birth_step" if adam_steps == "per_row" else "steps: int"
    for line in recording:
        scene = {"history": [tuple(h) for h in history], "step": now}
        if line.text.startswith("if start < self._most"):
            what = "A new row" if line["start"] else "The map starts with these rows"
            title = f"{what}: the values come from the seeds, and the moments m and v are 0."
            added = [("rows", f"{line['start']} to {line['stop'] - 1}")]
            steps.append(Step(line=line, title=title, numbers=added, scene=scene))
        elif line.text.startswith(counting):
            t = "none: no correction" if line["steps"] is None else text_of(line["steps"])
            numbers = [("step of the map", str(line["t"])), ("t of each row", t)]
            steps.append(Step(line=line, title="What the bias correction counts.", numbers=numbers, scene=scene))
        elif line.function == "adam_update" and line["param"].ndim == 1:
            if line.text.startswith("m = beta1"):
                start, now = line["param"], now + 1
            elif line.text.startswith("param.copy_"):
                moved = (line["param"] - start) / line["lr"]
                for k, by in enumerate(moved.tolist()):
                    history[k].append((now, abs(by), by))
                scene = {"history": [tuple(h) for h in history], "step": now}
            if (shown := _shown(line, start)) is not None:
                title, heads, columns = shown
                table = [(str(k), *cells) for k, cells in enumerate(zip(*columns, strict=True))]
                steps.append(Step(line=line, title=title, heads=("row", *heads), numbers=table, scene=scene))
    return steps


def _shown(line: Line, start: torch.Tensor) -> tuple[str, tuple[str, ...], list[list[str]]] | None:
    def column(name: str) -> list[str]:
        return [text_of(x) for x in line[name]]

    if line.text.startswith("m = beta1"):
        return "m moves one tenth of the way to the gradient g.", ("g", "m before", "m"), [
            column("gradient"), column("exp_avg"), column("m"),
        ]  # fmt: skip
    if line.text.startswith("v = beta2"):
        return "v moves one thousandth of the way to g².", ("g", "v before", "v"), [
            column("gradient"), column("exp_avg_sq"), column("v"),
        ]  # fmt: skip
    if line.text.startswith("m_hat, v_hat"):
        counted = line["steps"]
        t = (
            counted.double()
            if isinstance(counted, torch.Tensor)
            else [math.inf if counted is None else counted] * len(start)
        )
        title = "Bias correction: m and v started at 0, so they are divided by 1 − b^t."
        return title, ("t", "m hat", "v hat"), [[text_of(x) for x in t], column("m_hat"), column("v_hat")]
    if line.text.startswith("param.copy_"):
        moved = [f"{text_of(x, 3)} lr" for x in (line["param"] - start) / line["lr"]]
        return "The step of each row, in learning rates.", ("before", "after", "step"), [
            [text_of(x) for x in start], column("param"), moved,
        ]  # fmt: skip
    return None


def _picture(
    figure: "Figure", steps: Sequence[Step], others: dict[str, list[float]], before: int
) -> Callable[[Step], None]:
    above, below = figure.add_axes((0.12, 0.57, 0.86, 0.36)), figure.add_axes((0.12, 0.12, 0.86, 0.36))
    style(above, y="lr", title="length of each step, in learning rates (orange: the new row)")
    style(below, x="step", y="lr", title="how far each row has moved")
    last = steps[-1].scene["history"]
    count = len(last[0])
    lengths = [x for row in last for _, x, _ in row] + [x for other in others.values() for x in other]
    moved = [sum(by for _, _, by in row[: k + 1]) for row in last for k in range(len(row))]
    above.set_ylim(0, 1.15 * max(lengths))
    below.set_ylim(min(0.0, *moved) * 1.15 - 0.1, max(0.0, *moved) * 1.15 + 0.1)
    for axes in (above, below):
        axes.set_xlim(0.5, count + 0.5)
        axes.locator_params(axis="x", integer=True)
        axes.tick_params(labelbottom=axes is below)
        axes.axvline(before + 0.5, color=BETWEEN, linewidth=0.8, linestyle=":")
    for name, other in others.items():
        where = range(before + 1, before + 1 + len(other))
        above.plot(where, other, "--", color=PALETTE[1], alpha=0.55, linewidth=1)
        above.annotate(name, (count, other[-1]), color=BETWEEN, fontsize=7, ha="right", va="bottom")
    colours = [PALETTE[0], PALETTE[2], PALETTE[4], PALETTE[6]]
    inks = [colours[k % 4] for k in range(len(last) - 1)] + [PALETTE[1]]
    lines = [[a.plot([], [], ".-", color=ink, animated=True, markersize=6)[0] for ink in inks] for a in (above, below)]

    def update(step: Step) -> None:
        for k, row in enumerate(step.scene["history"]):
            at = [s for s, _, _ in row]
            lines[0][k].set_data(at, [x for _, x, _ in row])
            lines[1][k].set_data(at, [sum(by for _, _, by in row[: i + 1]) for i in range(len(row))])

    return update
