"""Small graphs beside each other, which are drawn anew after each step."""

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from .curves import CARD, CARD_INK, PALETTE, figure_picture, style
from .pictures import Picture

if TYPE_CHECKING:
    pass


def small_curves(
    series: Mapping[str, Sequence[float | int]],
    *,
    n_x: int,
    width: int,
    height: int = 110,
) -> Picture:
    """One small graph per series, in a row: its title and newest value above, the range of its
    values at the left.

    Args:
        series: Title -> values so far, one per step; NaN leaves a gap.
        n_x: Number of steps of the whole run, which fill the width, so that the curve also shows
            progress.
        width, height: Of the picture, pixels.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width / 100, height / 100), dpi=100, facecolor=CARD)
    every = figure.subplots(1, len(series), squeeze=False)[0]
    figure.subplots_adjust(
        50 / width,
        8 / height,
        1 - 8 / width,
        1 - 24 / height,
        60 * len(series) / width,
    )
    for axes, (title, values), ink in zip(
        every, series.items(), PALETTE * len(series), strict=False
    ):
        known = [v for v in values if math.isfinite(v)]
        axes.plot(
            np.arange(len(values)),
            np.array(values, float),
            color=ink,
            linewidth=1.5,
        )
        axes.set_xlim(0, max(n_x, len(values), 2) - 1)
        axes.set_xticks([])
        low, high = (min(known), max(known)) if known else (0.0, 1.0)
        axes.set_yticks(
            [low, high],
            [number(low), number(high)] if known else ["", ""],
        )
        axes.grid(axis="y", color=CARD_INK, alpha=0.2)
        style(axes, title=f"{title}  {number(known[-1])}" if known else title, ink=CARD_INK)
        for spine in axes.spines.values():
            spine.set_visible(False)
    return figure_picture(figure)


def number(value: float | int) -> str:
    """A value as short text for a small graph: 21.5, 3,294, 41.1k."""
    if abs(value) >= 10_000:
        return f"{value / 1000:,.1f}k"
    return f"{value:,.0f}" if abs(value) >= 100 or value == int(value) else f"{value:.1f}"
