"""How the time of a frame divides into stages, and a panel that speeds up single stages (Amdahl's law)."""

from collections.abc import Iterable, Mapping

import numpy as np

from ...drawing.curves import PALETTE
from ...drawing.pictures import CARD, CARD_INK, Picture, fit_width
from ...optim import Keyframe
from .panel import Drawn, Panel, Slider

_FAINT = (84, 92, 104)
_LEFT, _RIGHT, _BAR = 92, 14, 44


def stage_means(seconds: list[dict[str, float]], *, least_share: float = 0.002) -> dict[str, float]:
    """Mean time of each stage over the frames, seconds; very short stages are left out.

    Args:
        seconds: ``report.seconds`` of each step.
        least_share: A stage with a smaller share of the total is left out.
    """
    names = dict.fromkeys(name for s in seconds for name in s)
    means = {name: sum(s.get(name, 0.0) for s in seconds) / len(seconds) for name in names}
    total = sum(means.values())
    return {name: value for name, value in means.items() if value > least_share * total}


def stage_bars(runs: Mapping[str, Mapping[str, float]], *, width: int = 720) -> Picture:
    """One bar for each run, cut into its stages, all to the same scale.

    Args:
        runs: Label -> stage -> seconds per frame. At least one.
        width: Of the picture, pixels.
    """
    import cv2

    if not runs:
        raise ValueError("stage_bars needs at least one run, got none")
    stages = list(dict.fromkeys(stage for run in runs.values() for stage in run))
    longest = max(sum(run.values()) for run in runs.values()) or 1.0
    image = np.full((len(runs) * (_BAR + 26) + 34, width, 3), CARD, np.uint8)
    scale = (width - _LEFT - _RIGHT - 160) / longest
    for row, (label, run) in enumerate(runs.items()):
        y, x = row * (_BAR + 26) + 8, float(_LEFT)
        _text(image, label, 6, y + 28, CARD_INK)
        for stage in stages:
            long = run.get(stage, 0.0) * scale
            box = (round(x), y), (max(round(x + long) - 1, round(x)), y + _BAR)
            cv2.rectangle(image, *box, _colour(stages.index(stage)), -1)
            if long > 42:
                _text(image, _short(1e3 * run[stage]), round(x) + 6, y + 28, (255, 255, 255))
            x += long
        total = sum(run.values())
        rate = f"{_short(1e3 * total)} ms, {_short(1 / total)} frames/s" if total else ""
        _text(image, rate, round(x) + 6, y + 28, CARD_INK)
    x = _LEFT
    for k, stage in enumerate(stages):
        y = image.shape[0] - 24
        cv2.rectangle(image, (x, y), (x + 12, y + 12), _colour(k), -1)
        _text(image, stage, x + 17, y + 11, CARD_INK)
        x += 34 + 9 * len(stage)
    return image


def sped_up(seconds: Mapping[str, float], factors: Mapping[str, float | int]) -> dict[str, float]:
    """The stages' times if each were ``factors[stage]`` times as fast."""
    return {stage: value / factors.get(stage, 1.0) for stage, value in seconds.items()}


def amdahl_panel(seconds: Mapping[str, float], *, width: int = 720) -> Panel:
    """A slider for the speed-up of each stage, and bars of a frame's time before and after.

    Args:
        seconds: Stage -> seconds per frame.
        width: Of the picture, pixels.
    """
    before = dict(seconds)

    def draw(**factors: float) -> Drawn:
        after = sped_up(before, factors)
        gain = sum(before.values()) / sum(after.values())
        largest = max(after, key=lambda stage: after[stage])
        words = (
            f'<b class="gsnb-amdahl-gain">{gain:.2f}</b> times as fast<br>largest remaining stage: {largest}, '
            f"{100 * after[largest] / sum(after.values()):.0f} %"
        )
        return stage_bars({"now": before, "then": after}, width=width), words

    controls = {
        stage: Slider(value=1.0, low=1.0, high=1000.0, step=0.05, label=f"{stage}, times", log=True, readout=".1f")
        for stage in before
    }
    return Panel(draw, controls, name="amdahl", kind="png", text="Amdahl panel")


def _short(number: float) -> str:
    """Three digits, or all digits of the whole number from 1000 on."""
    return f"{number:.3g}" if number < 1000 else f"{number:,.0f}"


def _colour(k: int) -> tuple[int, ...]:
    colour = PALETTE[k % len(PALETTE)]
    return tuple(int(colour[i : i + 2], 16) for i in (1, 3, 5))


def _text(image: Picture, words: str, x: int, y: int, ink: tuple[int, ...]) -> None:
    import cv2

    cv2.putText(image, words, (x, y), cv2.FONT_HERSHEY_SIMPLEX, 0.42, ink, 1, cv2.LINE_AA)


_BAR_PX = 14


def keyframe_strip(keyframes: Iterable[Keyframe], *, columns: int = 10, width: int = 900, most: int = 40) -> Picture:
    """Thumbnails in rows, in the order they were taken, each with its frame number under it.

    Args:
        keyframes: ``mapper.keyframes``.
        columns: Pictures in a row.
        width: Of the whole strip, pixels.
        most: At most this many keyframes are shown, evenly spread over the run.

    Returns:
        White where there is nothing; one white row of pixels if there are no keyframes.
    """
    shown = list(keyframes)
    if len(shown) > most:
        shown = [shown[round(i * (len(shown) - 1) / (most - 1))] for i in range(most)]
    tiles = [_tile(keyframe, width // columns) for keyframe in shown]
    rows = [tiles[i : i + columns] for i in range(0, len(tiles), columns)]
    if not rows:
        return np.full((1, width, 3), 255, np.uint8)
    return np.concatenate([_row(row, width) for row in rows])


def _tile(keyframe: Keyframe, width: int) -> Picture:
    import cv2

    small = fit_width(keyframe.rgb_u8.cpu().numpy(), width - 4)
    tile = np.full((small.shape[0] + _BAR_PX + 4, width, 3), 255, np.uint8)
    tile[: small.shape[0], : small.shape[1]] = small
    place = (2, small.shape[0] + _BAR_PX - 3)
    cv2.putText(tile, f"{keyframe.index}", place, cv2.FONT_HERSHEY_SIMPLEX, 0.38, (60, 70, 84), 1, cv2.LINE_AA)
    return tile


def _row(tiles: list[Picture], width: int) -> Picture:
    row = np.full((max(t.shape[0] for t in tiles), width, 3), 255, np.uint8)
    x = 0
    for tile in tiles:
        row[: tile.shape[0], x : x + tile.shape[1]] = tile
        x += tile.shape[1]
    return row
