"""A stepper through the quadtree that places Gaussians."""

from typing import TYPE_CHECKING, Any, Literal

import torch

from ...drawing.curves import PALETTE
from ...drawing.pictures import AnyImage, Picture, to_uint8
from ...seeding import quadtree
from .recording import RETURNED, Line, Recording, record
from .stepper import Step, Stepper, text_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure


RELEASED = "V * (H * W) / QUADTREE_NORMALISER"

STD = "V**0.5 / 255"
"""The two contrasts, as the code writes them."""

QUADTREE_WATCH = {
    quadtree: {
        "is_cut": (
            "x0",
            "y0",
            "w",
            "h",
            "V",
            "min_cell_px",
            "threshold",
            "contrast",
            RELEASED,
            STD,
        ),
        "leaves": ("cell", "level"),
        "quadtree": (),
    }
}


def quadtree_stepper(
    rgb: AnyImage,
    *,
    threshold: float | int = 0.1,
    min_cell_px: int = 1,
    contrast: Literal["released", "std"] = "released",
) -> Stepper:
    """Press Next through ``quadtree``: two steps for each cell, its contrast and what follows from
    it.

    The cell that is looked at has a red border, finished leaves have blue ones.

    Args:
        rgb: A small image; one of 80 x 60 pixels already has a few hundred cells. [H, W, 3]
        threshold, min_cell_px, contrast: As for ``quadtree``.
    """
    photo = to_uint8(rgb)
    settings = {"threshold": float(threshold), "min_cell_px": min_cell_px, "contrast": contrast}
    steps = _quadtree_steps(
        record(lambda: quadtree(torch.from_numpy(photo), **settings), QUADTREE_WATCH)
    )
    height = round(450 * photo.shape[0] / photo.shape[1])
    label = f"Quadtree of a picture of {photo.shape[1]} x {photo.shape[0]} pixels"
    draw = lambda figure, scene: _quadtree_picture(figure, scene, photo)  # noqa: E731
    return Stepper(steps, draw, name="quadtree", label=label, size=(450, height))


def _quadtree_steps(recording: Recording) -> list[Step]:
    looks = [line for line in recording if line.function == "is_cut" and RETURNED in line.values]
    ends: dict[int, Line] = {line.call: line for line in recording if line.function == "leaves"}
    steps: list[Step] = []
    leaves: list[tuple[int, ...]] = []
    waiting = 1
    for look in sorted(looks, key=lambda line: line.call):
        cell = tuple(look[name] for name in ("x0", "y0", "w", "h"))
        waiting = waiting - 1
        is_cut = look[RETURNED]
        end = ends[look.call]
        scene = {"cell": cell, "leaves": tuple(leaves), "cut": False}
        steps.append(
            Step(
                look,
                _look_title(look, end["level"]),
                _numbers(look),
                scene,
            )
        )
        if is_cut:
            waiting += 4
            title = "Split: its four parts are looked at one after the other, top left first."
        else:
            leaves.append(cell)
            title = "Not split: this cell is a leaf."
        counts = [
            ("leaves so far", str(len(leaves))),
            ("cells that wait", str(waiting)),
            ("level", str(end["level"])),
        ]
        scene = {"cell": cell, "leaves": tuple(leaves), "cut": is_cut}
        steps.append(Step(end, title, counts, scene))
    cells = recording.result
    last = recording.at("return Cells(")[0]
    counts = [
        (f"level {k}", str(int(n))) for k, n in enumerate(torch.bincount(cells.level.long())) if n
    ]
    scene = {"cell": None, "leaves": tuple(leaves), "cut": False}
    end_title = f"Every cell has been looked at: {len(cells)} leaves."
    steps.append(
        Step(
            last,
            end_title,
            [("leaves", str(len(cells))), *counts],
            scene,
        )
    )
    return steps


def _look_title(look: Line, level: int) -> str:
    x0, y0, w, h = (look[name] for name in ("x0", "y0", "w", "h"))
    place = f"Level {level}: the cell of {w} x {h} pixels at ({x0}, {y0})"
    if "V" not in look.values:
        return f"{place} is too small to be split; its contrast is not computed."
    return f"{place} has a contrast {'above' if look[RETURNED] else 'not above'} the threshold."


def _numbers(look: Line) -> list[tuple[str, str]]:
    w = look["w"]
    h = look["h"]
    halves = ("half its size", f"{w // 2} x {h // 2}, must be above {look['min_cell_px']}")
    if "V" not in look.values:
        return [halves]
    contrast = look[RELEASED if look["contrast"] == "released" else STD]
    return [
        halves,
        ("V, variance of the luma", text_of(look["V"])),
        ("contrast", text_of(contrast)),
        ("threshold", text_of(look["threshold"])),
        ("split", text_of(look[RETURNED])),
    ]


def _quadtree_picture(figure: "Figure", scene: dict[str, Any], photo: Picture) -> None:
    from matplotlib.collections import LineCollection

    H, W = photo.shape[:2]
    axes = figure.add_axes((0.005, 0.005, 0.99, 0.99))
    axes.imshow(photo, extent=(0, W, H, 0), interpolation="nearest")
    axes.set_axis_off()
    axes.add_collection(
        LineCollection(
            [_outline(cell) for cell in scene["leaves"]], colors=PALETTE[0], linewidths=1.0
        )
    )
    if scene["cell"]:
        axes.plot(
            *zip(*_outline(scene["cell"]), strict=True),
            color=PALETTE[3],
            linewidth=2.6,
        )
    if scene["cut"]:
        x0, y0, w, h = scene["cell"]
        x = x0 + w // 2
        y = y0 + h // 2
        axes.plot(
            [x, x],
            [y0, y0 + h],
            [x0, x0 + w],
            [y, y],
            color=PALETTE[3],
            linewidth=1.4,
        )


def _outline(cell: tuple[int, ...]) -> list[tuple[int, int]]:
    x0, y0, w, h = cell
    return [(x0, y0), (x0 + w, y0), (x0 + w, y0 + h), (x0, y0 + h), (x0, y0)]
