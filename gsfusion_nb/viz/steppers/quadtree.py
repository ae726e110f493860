"""A stepper through the quadtree of a picture: which cell is looked at, its contrast, and whether it is split."""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Literal

import torch

from ...drawing.curves import PALETTE
from ...drawing.pictures import AnyImage, Picture, to_uint8
from ...seeding import quadtree
from .recording import RETURNED, Line, Recording, record
from .stepper import Step, Stepper, text_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure

RELEASED, STD = "V * (H * W) / QUADTREE_NORMALISER", "V**0.5 / 255"
"""The two contrasts, as the code writes them."""
WATCH = {
    quadtree: {
        "is_cut": ("x0", "y0", "w", "h", "V", "min_cell_px", "threshold", "contrast", RELEASED, STD),
        "leaves": ("cell", "level"),
        "quadtree": (),
    }
}


def record_quadtree(rgb: AnyImage, **settings: Any) -> Recording:
    """``quadtree`` of an image: a recording."""
    return record(lambda: quadtree(torch.from_numpy(to_uint8(rgb)), **settings), WATCH)


def quadtree_stepper(
    rgb: AnyImage,
    *,
    threshold: float | int = 0.1,
    min_cell_px: int = 1,
    contrast: Literal["released", "std"] = "released",
) -> Stepper:
    """Press Next through ``quadtree``: two steps for each cell, its contrast and what follows from it.

    The cell that is looked at has a red border, finished leaves have blue ones.

    Args:
        rgb: A small image; one of 80 x 60 pixels already has a few hundred cells. [H, W, 3]
        threshold, min_cell_px, contrast: As for ``quadtree``.
    """
    photo = to_uint8(rgb)
    settings = {"threshold": float(threshold), "min_cell_px": min_cell_px, "contrast": contrast}
    steps = _steps(record_quadtree(photo, **settings))
    height = round(450 * photo.shape[0] / photo.shape[1])
    label = f"Quadtree of a picture of {photo.shape[1]} x {photo.shape[0]} pixels"
    stills = (1, min(len(steps) - 1, 2 + len(steps) // 3), len(steps) - 1)
    build = lambda figure: _picture(figure, photo)  # noqa: E731
    return Stepper(steps, build, name="quadtree", label=label, size=(450, height), stills=stills)


def _steps(recording: Recording) -> list[Step]:
    looks = [line for line in recording if line.function == "is_cut" and RETURNED in line.values]
    ends: dict[int, Line] = {line.call: line for line in recording if line.function == "leaves"}
    steps: list[Step] = []
    leaves: list[tuple[int, ...]] = []
    waiting = 1
    for look in sorted(looks, key=lambda line: line.call):
        cell, waiting = tuple(look[name] for name in ("x0", "y0", "w", "h")), waiting - 1
        is_cut, end = look[RETURNED], ends[look.call]
        scene = {"cell": cell, "leaves": tuple(leaves), "cut": False}
        steps.append(Step(line=look, title=_seen(look, end["level"]), numbers=_numbers(look), scene=scene))
        if is_cut:
            waiting += 4
            title = "Split: its four parts are looked at one after the other, top left first."
        else:
            leaves.append(cell)
            title = "Not split: this cell is a leaf."
        counts = [("leaves so far", str(len(leaves))), ("cells that wait", str(waiting)), ("level", str(end["level"]))]
        scene = {"cell": cell, "leaves": tuple(leaves), "cut": is_cut}
        steps.append(Step(line=end, title=title, numbers=counts, scene=scene))
    cells = recording.result
    last = recording.at("return Cells(")[0]
    counts = [(f"level {k}", str(int(n))) for k, n in enumerate(torch.bincount(cells.level.long())) if n]
    scene = {"cell": None, "leaves": tuple(leaves), "cut": False}
    done = f"Every cell has been looked at: {len(cells)} leaves."
    steps.append(Step(line=last, title=done, numbers=[("leaves", str(len(cells))), *counts], scene=scene))
    return steps


def _seen(look: Line, level: int) -> str:
    x0, y0, w, h = (look[name] for name in ("x0", "y0", "w", "h"))
    place = f"Level {level}: the cell of {w} x {h} pixels at ({x0}, {y0})"
    if "V" not in look.values:
        return f"{place} is too small to be split; its contrast is not computed."
    return f"{place} has a contrast {'above' if look[RETURNED] else 'not above'} the threshold."


def _numbers(look: Line) -> list[tuple[str, str]]:
    w, h = look["w"], look["h"]
    halves = ("half its size", f"{w // 2} x {h // 2}, must be above {look['min_cell_px']}")
    if "V" not in look.values:
        return [halves]
    contrast = look[RELEASED if look["contrast"] == "released" else STD]
    return [
        halves, ("V, variance of the luma", text_of(look["V"])), ("contrast", text_of(contrast)),
        ("threshold", text_of(look["threshold"])), ("split", text_of(look[RETURNED])),
    ]  # fmt: skip


def _picture(figure: "Figure", photo: Picture) -> Callable[[Step], None]:
    from matplotlib.collections import LineCollection

    H, W = photo.shape[:2]
    axes = figure.add_axes((0.005, 0.005, 0.99, 0.99))
    axes.imshow(photo, extent=(0, W, H, 0), interpolation="nearest")
    axes.set_axis_off()
    borders = LineCollection([], colors=PALETTE[0], linewidths=1.0, animated=True)
    axes.add_collection(borders)
    (now,) = axes.plot([], [], "-", color=PALETTE[3], linewidth=2.6, animated=True)
    (cross,) = axes.plot([], [], "-", color=PALETTE[3], linewidth=1.4, animated=True)

    def update(step: Step) -> None:
        borders.set_segments([_outline(cell) for cell in step.scene["leaves"]])
        cell = step.scene["cell"]
        now.set_data(*(zip(*_outline(cell), strict=True) if cell else ([], [])))
        x0, y0, w, h = cell or (0, 0, 0, 0)
        x, y, gap = x0 + w // 2, y0 + h // 2, float("nan")
        cross.set_data(*(([x, x, gap, x0, x0 + w], [y0, y0 + h, gap, y, y]) if step.scene["cut"] else ([], [])))

    return update


def _outline(cell: tuple[int, ...]) -> list[tuple[int, int]]:
    x0, y0, w, h = cell
    return [(x0, y0), (x0 + w, y0), (x0 + w, y0 + h), (x0, y0 + h), (x0, y0)]
