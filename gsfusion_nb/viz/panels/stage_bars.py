"""How the time of a frame divides into stages, and a panel that speeds up single stages (Amdahl's
law)."""

from collections.abc import Iterable, Mapping

import numpy as np

from ...drawing.curves import CARD_INK, PALETTE, card_figure, figure_picture, style
from ...drawing.pictures import Picture, fit_width, side_by_side
from ...errors import ArgumentError
from ...optim import Keyframe
from .panel import Drawn, Panel, Slider


def stage_means(
    seconds: list[dict[str, float]],
    *,
    least_share: float = 0.002,
) -> dict[str, float]:
    """Mean time of each stage over the frames, seconds; very short stages are left out.

    Args:
        seconds: ``report.seconds`` of each step.
        least_share: A stage with a smaller share of the total is left out.
    """
    names = dict.fromkeys(name for s in seconds for name in s)
    means = {name: sum(s.get(name, 0.0) for s in seconds) / len(seconds) for name in names}
    total = sum(means.values())
    return {name: value for name, value in means.items() if value > least_share * total}


def stage_bars(
    runs: Mapping[str, Mapping[str, float]],
    *,
    width: int = 720,
) -> Picture:
    """One bar for each run, cut into its stages, all to the same scale.

    Args:
        runs: Label -> stage -> seconds per frame. At least one.
        width: Of the picture, pixels.
    """
    if not runs:
        raise ArgumentError("stage_bars needs at least one run, got none")
    figure, (axes,) = card_figure(width, 70 * len(runs) + 60)
    longest = max(sum(run.values()) for run in runs.values()) or 1.0
    offsets = dict.fromkeys(runs, 0.0)
    for stage, ink in zip(
        dict.fromkeys(stage for run in runs.values() for stage in run),
        PALETTE * 3,
        strict=False,
    ):
        ms = [1e3 * run.get(stage, 0.0) for run in runs.values()]
        bars = axes.barh(
            list(runs),
            ms,
            left=list(offsets.values()),
            color=ink,
            label=stage,
        )
        labels = [_short(x) if x > 60 * longest else "" for x in ms]
        axes.bar_label(bars, labels, label_type="center", color="white", fontsize=8)
        offsets = {label: offsets[label] + x for label, x in zip(runs, ms, strict=True)}
    rates = [f" {_short(x)} ms, {_short(1e3 / x)} frames/s" if x else "" for x in offsets.values()]
    for row, rate in enumerate(rates):
        axes.text(
            list(offsets.values())[row],
            row,
            rate,
            color=CARD_INK,
            fontsize=8,
            va="center",
        )
    axes.set_xlim(0, 1250 * longest)
    axes.invert_yaxis()
    style(axes, x="ms per frame", ink=CARD_INK)
    figure.legend(
        loc="outside lower left",
        ncols=8,
        frameon=False,
        labelcolor=CARD_INK,
        fontsize=8,
        handlelength=1,
    )
    return figure_picture(figure)


def sped_up(
    seconds: Mapping[str, float],
    factors: Mapping[str, float | int],
) -> dict[str, float]:
    """The stages' times if each were ``factors[stage]`` times as fast."""
    return {stage: value / factors.get(stage, 1.0) for stage, value in seconds.items()}


def amdahl_panel(seconds: Mapping[str, float], *, width: int = 720) -> Panel:
    """A slider for the speed-up of each stage, and bars of a frame's time before and after.

    Args:
        seconds: Stage -> seconds per frame.
        width: Of the picture, pixels.
    """
    old_seconds = dict(seconds)

    def draw(**factors: float) -> Drawn:
        new_seconds = sped_up(old_seconds, factors)
        gain = sum(old_seconds.values()) / sum(new_seconds.values())
        largest = max(new_seconds, key=lambda stage: new_seconds[stage])
        words = (
            f'<b class="gsnb-amdahl-gain">{gain:.2f}</b> times as fast<br>largest remaining stage: '
            f"{largest}, "
            f"{100 * new_seconds[largest] / sum(new_seconds.values()):.0f} %"
        )
        return stage_bars({"now": old_seconds, "then": new_seconds}, width=width), words

    controls = {
        stage: Slider(
            value=1.0,
            low=1.0,
            high=1000.0,
            step=0.05,
            label=f"{stage}, times",
            log=True,
            readout=".1f",
        )
        for stage in old_seconds
    }
    return Panel(draw, controls, name="amdahl", kind="png", text="Amdahl panel")


def _short(number: float) -> str:
    """Three digits, or all digits of the whole number from 1000 on."""
    return f"{number:.3g}" if number < 1000 else f"{number:,.0f}"


def keyframe_strip(
    keyframes: Iterable[Keyframe],
    *,
    columns: int = 10,
    width: int = 900,
    most: int = 40,
) -> Picture:
    """Thumbnails in rows, in the order they were taken, each with its frame number above it.

    Args:
        keyframes: ``mapper.keyframes``.
        columns: Pictures in a row.
        width: Of the whole strip, pixels.
        most: At most this many keyframes are shown, evenly spread over the run.

    Returns:
        One white row of pixels if there are no keyframes.
    """
    all_keyframes = list(keyframes)
    if not all_keyframes:
        return np.full((1, width, 3), 255, np.uint8)
    rows = sorted({round(i * (len(all_keyframes) - 1) / max(most - 1, 1)) for i in range(most)})
    tiles = [fit_width(all_keyframes[k].rgb_u8.cpu().numpy(), width // columns - 6) for k in rows]
    blank = np.full_like(tiles[0], 255)
    tiles += [blank] * (-len(tiles) % columns)
    names = [str(all_keyframes[k].index) for k in rows] + [""] * (len(tiles) - len(rows))
    starts = range(0, len(tiles), columns)
    return np.concatenate(
        [side_by_side(tiles[i : i + columns], names[i : i + columns]) for i in starts]
    )
