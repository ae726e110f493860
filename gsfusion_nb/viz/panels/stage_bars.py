"""How the time of a frame divides into stages, and a panel that speeds up single stages (Amdahl's
law)."""

from collections.abc import Iterable, Mapping

import numpy as np

from ...drawing.curves import CARD, CARD_INK, PALETTE, card_figure, figure_picture, rgb_of, style
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


_NAMED_SHARE = 0.06
"""A part of a bar that is at least this long, of the axis, has its number in it."""


def stage_bars(
    runs: Mapping[str, Mapping[str, float]],
    *,
    shares: bool = False,
    width: int = 720,
) -> Picture:
    """One bar for each run, cut into its stages.

    Args:
        runs: Label -> stage -> seconds per frame. At least one.
        shares: All bars are equally long, so that the stages of a fast run can be seen beside those
            of a slow one; a part has its share in it, per cent. Otherwise all bars have the same
            scale, milliseconds.
        width: Of the picture, pixels.
    """
    if not runs:
        raise ArgumentError("stage_bars needs at least one run, got none")
    figure, (axes,) = card_figure(width, 70 * len(runs) + 60)
    total_ms = [1e3 * sum(run.values()) for run in runs.values()]
    scales = [100 / (ms or 1.0) if shares else 1.0 for ms in total_ms]
    longest = max(ms * scale for ms, scale in zip(total_ms, scales, strict=True)) or 1.0
    ends = np.zeros(len(runs))
    for stage, ink in zip(
        dict.fromkeys(stage for run in runs.values() for stage in run),
        PALETTE * 3,
        strict=False,
    ):
        lengths = np.array(
            [1e3 * run.get(stage, 0.0) * s for run, s in zip(runs.values(), scales, strict=True)]
        )
        bars = axes.barh(
            list(runs),
            lengths,
            left=ends,
            color=ink,
            edgecolor=CARD,
            linewidth=0.6,
            label=stage,
        )
        unit = " %" if shares else ""
        labels = [_short(x) + unit if x > _NAMED_SHARE * longest else "" for x in lengths]
        axes.bar_label(bars, labels, label_type="center", color=_ink_on(ink), fontsize=8)
        ends = ends + lengths
    for row, (end, ms) in enumerate(zip(ends, total_ms, strict=True)):
        rate = f" {_short(ms)} ms, {_short(1e3 / ms)} frames/s" if ms else ""
        axes.text(end, row, rate, color=CARD_INK, fontsize=8, va="center")
    axes.set_xlim(0, 1.32 * longest)
    if shares:
        axes.set_xticks(range(0, 101, 20))
    axes.invert_yaxis()
    style(axes, x="% of the frame" if shares else "ms per frame", ink=CARD_INK)
    figure.legend(
        loc="outside lower left",
        ncols=8,
        frameon=False,
        labelcolor=CARD_INK,
        fontsize=8,
        handlelength=1,
    )
    return figure_picture(figure)


def _ink_on(colour: str) -> str:
    """Black or white, whichever can be read on a colour."""
    return "black" if np.dot(rgb_of(colour), (0.299, 0.587, 0.114)) > 140 else "white"


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
