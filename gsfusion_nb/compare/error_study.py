"""``gsfusion-nb study errors``: in which pixels of the held-out views a map is wrong.

A mean error of two centimetres may be a few pixels at the edges of things, or a surface that lies
two centimetres too far away everywhere. They have different reasons, so the pixels are parted by
what is known of them without the map (``pixel_kinds``).
"""

import json
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ..data import OpenedSequence
from ..drawing.pictures import to_uint8
from ..errors import ArgumentError
from ..evaluation import expected_depth_m
from ..evaluation.image import to_8bit_grid
from ..files import write_file
from ..runs.mapped_views import evenly
from ..types import Frame, RenderOutput
from .map_scene import Entry, budgeted, finished, map_scene
from .markdown import number_text, plain_markdown
from .pixel_kinds import BORDER, EDGE_JUMP, EDGE_PX, FEW_VIEWS, LEANING_DEG, pixel_kinds
from .recording_specs import (
    RecordingOptions,
    check_one_process,
    labels_with,
    ran_under,
    recording_specs,
)
from .spec import RunSpec
from .view_study import SYSTEMS

if TYPE_CHECKING:
    from matplotlib.figure import Figure

QUESTION = "Where a map is wrong: error of depth and colour in held-out views by kind of pixel"
MOST_MAPPED_VIEWS = 64
"""Mapped views that are asked which places they show, evenly spread."""
ERROR_SHOWN_M = 0.05
"""Depth error with the strongest colour in the picture, metres."""
ABOUT = f"""\
Pixels of held-out views with depth in the view and in the map. At an edge: within {EDGE_PX} pixels
of a jump of {100 * EDGE_JUMP:.0f} % in the depth. All rows below are of pixels that are not at an
edge, and may overlap. Leaning: {LEANING_DEG:.0f} degrees or more. In few views: at most
{100 * FEW_VIEWS:.0f} % of the mapped views show the place. Border: the outer {100 * BORDER:.0f} %
of the picture's width. Bias: mean signed depth error, positive behind the surface. Shares are of
the sum over all pixels: of the absolute depth error, and of the squared colour error.
"""

Sums = dict[str, float]
"""What is added up over pixels, by name."""


@dataclass(frozen=True, kw_only=True)
class ErrorPart:
    """The errors of one kind of pixel in all held-out views of a map."""

    pixels: float
    """Share of the pixels, 0 to 1."""
    depth_l1_m: float
    """Mean absolute depth error, metres; NaN without pixels."""
    depth_bias_m: float
    """Mean signed depth error, metres; positive where the map is behind the measured surface."""
    depth_share: float
    """Share of the absolute depth error of all pixels, 0 to 1."""
    colour_share: float
    """Share of the squared colour error of all pixels, 0 to 1."""


def main(options: RecordingOptions, data: str, folder: Path, only: str = "") -> int:
    """``gsfusion-nb study errors``: print the table, and write it and a picture to ``folder``.

    Raises:
        ValueError: no view is held out, ``only`` leaves nothing, or more than one process is asked
            for.
    """
    check_one_process(options, "errors")
    variants = {label: {"system": SYSTEMS[label]} for label in labels_with(only, SYSTEMS, "system")}
    specs = recording_specs(variants, options, data, common={"tracking.poses": "given"})
    sequence = Entry(spec=specs[0]).opened()
    if not len(sequence.held_out):
        raise ArgumentError("no view is held out: set data.hold_out_every to 2 or more")
    print(f"{QUESTION}, on {data}\n{ran_under(specs)}", flush=True)
    maps = []
    for spec in specs:
        errors = map_errors(spec, sequence)
        maps.append(errors)
        whole = errors.parts["all pixels"]
        print(f"{errors.label}: depth {100 * whole.depth_l1_m:.2f} cm", flush=True)
    text = as_markdown(maps)
    print(f"\n{ABOUT}\n{text}")
    folder.mkdir(parents=True, exist_ok=True)
    write_file(folder / "table.md", f"{QUESTION}\n\n{ABOUT}\n{text}\n".encode())
    write_file(folder / "table.json", json.dumps(as_records(maps), indent=1).encode())
    errors_figure(maps).savefig(folder / "errors.png")
    print(f"\nFiles in {folder}")
    return 0


@dataclass(frozen=True, kw_only=True, eq=False)
class MapErrors:
    """Where one map is wrong."""

    label: str
    parts: dict[str, ErrorPart]
    """Kind of pixel -> its errors."""
    view: Frame
    """The middle held-out view."""
    depth_error_m: Float[Tensor, "H W"]
    """Signed depth error in that view, metres; NaN where view or map has no depth."""


def map_errors(spec: RunSpec, sequence: OpenedSequence) -> MapErrors:
    """Make a map and compare it with the held-out views.

    Args:
        spec: The run.
        sequence: Its frames; at least one is held out.
    """
    mapper = finished(map_scene(Entry(spec=spec, sequence=sequence), budgeted(spec))).run.mapper
    mapped = [sequence.mapping[i] for i in evenly(len(sequence.mapping), MOST_MAPPED_VIEWS)]
    middle = len(sequence.held_out) // 2
    kinds: dict[str, Sums] = {}
    shown = None
    for place, frame in enumerate(sequence.held_out):
        with torch.no_grad():
            picture = mapper.render(frame.camera, frame.T_WC)
        error_m = depth_error_m(picture, frame)
        add_sums(kinds, pixel_kinds(frame, mapped), error_m, squared_colour_error(picture, frame))
        if place == middle:
            shown = (frame, error_m)
    assert shown is not None
    label = spec.label if spec.seed == 0 else f"{spec.label}, seed {spec.seed}"
    return MapErrors(
        label=label, parts=parts_of(kinds), view=shown[0], depth_error_m=shown[1].cpu()
    )


def depth_error_m(picture: RenderOutput, frame: Frame) -> Float[Tensor, "H W"]:
    """Depth of the map minus the measured one, metres; NaN where one of them is missing."""
    depth_m = expected_depth_m(picture)
    measured_m = frame.depth_m.to(depth_m.device)
    return torch.where((depth_m > 0) & (measured_m > 0), depth_m - measured_m, torch.nan)


def squared_colour_error(picture: RenderOutput, frame: Frame) -> Float[Tensor, "H W"]:
    """Mean over the colours of the squared difference on 8 bits, as PSNR has it."""
    target = frame.rgb.to(picture.rgb.device)
    return (to_8bit_grid(picture.rgb) - to_8bit_grid(target)).square().mean(dim=2)


def add_sums(
    kinds: dict[str, Sums],
    masks: Iterator[tuple[str, Bool[Tensor, "H W"]]],
    error_m: Float[Tensor, "H W"],
    colour: Float[Tensor, "H W"],
) -> None:
    """Add the pixels of one view to the sums of their kinds; those without a depth error count
    nowhere."""
    known = ~error_m.isnan()
    for name, mask in masks:
        chosen = known & mask.to(known.device)
        error = error_m[chosen].double()
        sums = kinds.setdefault(
            name, dict.fromkeys(("pixels", "absolute", "signed", "colour"), 0.0)
        )
        sums["pixels"] += len(error)
        sums["absolute"] += float(error.abs().sum())
        sums["signed"] += float(error.sum())
        sums["colour"] += float(colour[chosen].double().sum())


def parts_of(kinds: dict[str, Sums]) -> dict[str, ErrorPart]:
    """Means and shares of the sums; the shares are of the kind "all pixels"."""
    whole = kinds["all pixels"]
    return {
        name: ErrorPart(
            pixels=_ratio(sums["pixels"], whole["pixels"]),
            depth_l1_m=_ratio(sums["absolute"], sums["pixels"]),
            depth_bias_m=_ratio(sums["signed"], sums["pixels"]),
            depth_share=_ratio(sums["absolute"], whole["absolute"]),
            colour_share=_ratio(sums["colour"], whole["colour"]),
        )
        for name, sums in kinds.items()
    }


def _ratio(part: float, whole: float) -> float:
    return part / whole if whole else math.nan


def as_records(maps: Sequence[MapErrors]) -> dict[str, dict[str, float | None]]:
    """ "Label; kind of pixel" -> its numbers; None where there is none."""
    return {
        f"{errors.label}; {kind}": {
            field.name: None if math.isnan(value := getattr(part, field.name)) else value
            for field in fields(part)
        }
        for errors in maps
        for kind, part in errors.parts.items()
    }


def as_markdown(maps: Sequence[MapErrors]) -> str:
    """A row for each map and kind of pixel: depth in centimetres, shares in per cent."""
    heads = ["map", "pixels", "share, %", "depth error, cm", "bias, cm"]
    heads += ["share of the depth error, %", "of the colour error, %"]
    lines = [f"| {' | '.join(heads)} |", "|---|---|" + "---:|" * (len(heads) - 2)]
    for errors in maps:
        for kind, part in errors.parts.items():
            cells = [
                number_text(100 * part.pixels, ".0f"),
                number_text(100 * part.depth_l1_m, ".2f"),
                number_text(100 * part.depth_bias_m, "+.2f"),
                number_text(100 * part.depth_share, ".0f"),
                number_text(100 * part.colour_share, ".0f"),
            ]
            lines.append(f"| {' | '.join([plain_markdown(errors.label), kind, *cells])} |")
    return "\n".join(lines)


def errors_figure(maps: Sequence[MapErrors]) -> "Figure":
    """The middle held-out view, and the signed depth error of each map there: red is behind the
    surface, blue in front of it, grey without depth."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(
        figsize=(3.4 * (1 + len(maps)), 2.9), dpi=100, facecolor="white", layout="constrained"
    )
    FigureCanvasAgg(figure)
    axes = figure.subplots(1, 1 + len(maps), squeeze=False)[0]
    axes[0].imshow(to_uint8(maps[0].view.rgb))
    axes[0].set_title(f"held-out view {maps[0].view.index}", fontsize=9)
    image = None
    for plot, errors in zip(axes[1:], maps, strict=True):
        plot.set_facecolor("0.5")
        image = plot.imshow(
            100 * errors.depth_error_m.numpy(),
            cmap="RdBu_r",
            vmin=-100 * ERROR_SHOWN_M,
            vmax=100 * ERROR_SHOWN_M,
        )
        whole = errors.parts["all pixels"]
        plot.set_title(f"{errors.label}: {100 * whole.depth_l1_m:.2f} cm in all views", fontsize=9)
    for plot in axes:
        plot.set_xticks([])
        plot.set_yticks([])
    if image is not None:
        figure.colorbar(image, ax=list(axes[1:]), label="behind the surface, cm", shrink=0.8)
    return figure
