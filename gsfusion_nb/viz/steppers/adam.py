"""A stepper through Adam on rows that join later."""

import dataclasses
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import torch

from ...config import OptimConfig
from ...drawing.curves import BETWEEN, PALETTE, style
from ...errors import ArgumentError
from ...gaussians import GaussianModel
from ...optim import adam_step
from ...optim.adam import adam_update
from ...types import GaussianParams, Seeds
from .recording import Line, Recording, record
from .stepper import Step, Stepper, text_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure


Count = Literal["per_row", "shared", "none"]


COUNTS: tuple[Count, ...] = ("per_row", "shared", "none")


ADAM_WATCH = {
    adam_update: {
        "adam_step": ("t", "steps", "model.clock.birth"),
        "adam_update": (
            "param",
            "gradient",
            "exp_avg",
            "exp_avg_sq",
            "m",
            "v",
            "steps",
            "m_hat",
            "v_hat",
            "lr",
        ),
    },
    GaussianModel: {"append": ("rows",)},
}


def record_adam(
    gradient: Sequence[float | int],
    config: OptimConfig,
    *,
    before: int,
    after: int,
    earlier_steps: int = 0,
) -> Recording:
    """``adam_step`` on a map whose last row is added after ``before`` steps: a recording.

    Only the opacities have a gradient, the same at every step: ``gradient[k]`` for row k.
    """
    model = GaussianModel(sh_degree=0)
    model.clock.advance(earlier_steps)

    def seeds(n: int) -> Seeds:
        return Seeds.isotropic(
            torch.zeros(n, 3),
            torch.full((n, 3), 0.5),
            torch.full((n,), 0.1),
            opacity=0.5,
        )

    def run() -> None:
        model.append(seeds(len(gradient) - 1))
        for k in range(before + after):
            if k == before:
                model.append(seeds(1))
            zero = {name: torch.zeros_like(value) for name, value in vars(model.params).items()}
            v_opacity = torch.tensor([float(g) for g in gradient[: len(model)]])
            adam_step(model, GaussianParams(**zero | {"opacity_logit": v_opacity}), config)

    return record(run, ADAM_WATCH)


def adam_stepper(
    gradient: Sequence[float | int] = (0.3, -0.1, 0.3),
    *,
    adam_steps: Count = "per_row",
    before: int = 4,
    after: int = 5,
    earlier_steps: int = 0,
) -> Stepper:
    """Press Next through steps of Adam on a map to which a Gaussian is added in between.

    Shown are the opacities; the gradient of each row is the same at all steps. Above: the length of
    each step, in learning rates; the last row is orange, and its steps with the two other counts
    are dashed. Below: the values.

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
        raise ArgumentError(
            "two rows or more, and at least one step before and after the last one is added, are "
            "needed"
        )
    how = {"before": before, "after": after, "earlier_steps": earlier_steps}
    config = dataclasses.replace(OptimConfig(), adam_steps=adam_steps)
    lengths = {
        name: _lengths(record_adam(gradient, dataclasses.replace(config, adam_steps=name), **how))
        for name in COUNTS
    }
    steps = _adam_steps(record_adam(gradient, config, **how), len(gradient), adam_steps)
    others = {name: lengths[name][before:] for name in COUNTS if name != adam_steps}
    last = steps[-1].scene["history"]
    draw = lambda figure, scene: _adam_picture(figure, scene["history"], last, others, before)  # noqa: E731
    return Stepper(
        steps,
        draw,
        name="adam",
        label=f"Adam on a growing map, count {adam_steps}",
        size=(450, 360),
    )


def _of_opacity(recording: Recording, part: str) -> list[Line]:
    """The lines of ``adam_update`` that belong to the opacities, the only column of one number per
    row."""
    return [line for line in recording.at(part) if line["param"].ndim == 1]


def _lengths(recording: Recording) -> list[float]:
    """Length of each step of the last row that there is, in learning rates."""
    moment_lines = _of_opacity(recording, "m = beta1 *")
    copy_lines = _of_opacity(recording, "param.copy_(")
    return [
        float((b["param"] - a["param"]).abs()[-1] / a["lr"])
        for a, b in zip(moment_lines, copy_lines, strict=True)
    ]


def _adam_steps(recording: Recording, rows: int, adam_steps: Count) -> list[Step]:
    steps: list[Step] = []
    history: list[list[tuple[int, float, float]]] = [[] for _ in range(rows)]
    n_steps = 0
    start = torch.zeros(0)
    counting = "steps = t - model.clock.birth" if adam_steps == "per_row" else "steps: int"
    for line in recording:
        scene = {"history": [tuple(h) for h in history], "step": n_steps}
        if line.text.startswith("params.xyz_W[rows]"):
            rows_added = line["rows"]
            what = "A new row" if rows_added.start else "The map starts with these rows"
            title = f"{what}: the values come from the seeds, and the moments m and v are 0."
            new_rows = [("rows", f"{rows_added.start} to {rows_added.stop - 1}")]
            steps.append(Step(line, title, new_rows, scene))
        elif line.text.startswith(counting):
            t = "none: no correction" if line["steps"] is None else text_of(line["steps"])
            numbers = [("step of the map", str(line["t"])), ("t of each row", t)]
            steps.append(Step(line, "What the bias correction counts.", numbers, scene))
        elif line.function == "adam_update" and line["param"].ndim == 1:
            if line.text.startswith("m = beta1"):
                start = line["param"]
                n_steps = n_steps + 1
            elif line.text.startswith("param.copy_"):
                motion = (line["param"] - start) / line["lr"]
                for k, by in enumerate(motion.tolist()):
                    history[k].append((n_steps, abs(by), by))
                scene = {"history": [tuple(h) for h in history], "step": n_steps}
            if (table_of_line := _table_of(line, start)) is not None:
                title, columns = table_of_line
                table = [
                    (str(k), *cells) for k, cells in enumerate(zip(*columns.values(), strict=True))
                ]
                steps.append(Step(line, title, table, scene, ("row", *columns)))
    return steps


ADAM_LINES = {
    "m = beta1": (
        "m moves one tenth of the way to the gradient g.",
        {"g": "gradient", "m before": "exp_avg", "m": "m"},
    ),
    "v = beta2": (
        "v moves one thousandth of the way to g².",
        {"g": "gradient", "v before": "exp_avg_sq", "v": "v"},
    ),
    "m_hat, v_hat": (
        "Bias correction: m and v started at 0, so they are divided by 1 − b^t.",
        {"t": "steps", "m hat": "m_hat", "v hat": "v_hat"},
    ),
}
"""Beginning of a line -> what it does, and the columns of its table: heading -> watched
expression."""


def _table_of(
    line: Line,
    start: torch.Tensor,
) -> tuple[str, dict[str, list[str]]] | None:
    """Title and columns of the table of a line, if it is shown."""

    def column(value: Any) -> list[str]:
        return [
            text_of(x) for x in (value if isinstance(value, torch.Tensor) else [value] * len(start))
        ]

    if line.text.startswith("param.copy_"):
        motion = [f"{text_of(x, 3)} lr" for x in (line["param"] - start) / line["lr"]]
        columns = {"before": column(start), "after": column(line["param"]), "step": motion}
        return "The step of each row, in learning rates.", columns
    for beginning, (title, names) in ADAM_LINES.items():
        if line.text.startswith(beginning):
            return title, {head: column(line[name]) for head, name in names.items()}
    return None


def _adam_picture(
    figure: "Figure",
    history: list[Any],
    last: list[Any],
    others: dict[str, list[float]],
    n_before: int,
) -> None:
    length_axes = figure.add_axes((0.12, 0.57, 0.86, 0.36))
    path_axes = figure.add_axes((0.12, 0.12, 0.86, 0.36))
    style(length_axes, y="lr", title="length of each step, in learning rates (orange: the new row)")
    style(path_axes, x="step", y="lr", title="how far each row has moved")
    count = len(last[0])
    path = [sum(by for _, _, by in row[: k + 1]) for row in last for k in range(len(row))]
    length_axes.set_ylim(
        0,
        1.15
        * max(
            [x for row in last for _, x, _ in row] + [x for other in others.values() for x in other]
        ),
    )
    path_axes.set_ylim(
        min(0.0, *path) * 1.15 - 0.1,
        max(0.0, *path) * 1.15 + 0.1,
    )
    for axes in (length_axes, path_axes):
        axes.set_xlim(0.5, count + 0.5)
        axes.locator_params(axis="x", integer=True)
        axes.tick_params(labelbottom=axes is path_axes)
        axes.axvline(n_before + 0.5, color=BETWEEN, linewidth=0.8, linestyle=":")
    for name, other in others.items():
        length_axes.plot(
            range(n_before + 1, n_before + 1 + len(other)),
            other,
            "--",
            color=PALETTE[1],
            alpha=0.55,
            linewidth=1,
        )
        length_axes.annotate(
            name,
            (count, other[-1]),
            color=BETWEEN,
            fontsize=7,
            ha="right",
            va="bottom",
        )
    inks = [PALETTE[2 * (k % 4)] for k in range(len(last) - 1)] + [PALETTE[1]]
    for row, ink in zip(history, inks, strict=True):
        at = [step for step, _, _ in row]
        length_axes.plot(
            at,
            [x for _, x, _ in row],
            ".-",
            color=ink,
            markersize=6,
        )
        path_axes.plot(
            at,
            np.cumsum([by for _, _, by in row]),
            ".-",
            color=ink,
            markersize=6,
        )
