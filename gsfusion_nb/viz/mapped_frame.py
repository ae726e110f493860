"""What is drawn of a frame after it was mapped: the panels of a system, and their row in a
notebook."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from torch import Tensor

from ..drawing import pictures as draw
from ..drawing.pictures import Picture, paint_cells, side_by_side, to_uint8
from ..evaluation import expected_depth_m
from ..mapping import Mapper
from ..types import Frame, RenderOutput
from .map_pictures import cause_picture, paint_rows, state_picture

SEED_COLOUR = (255, 48, 64)


@dataclass(frozen=True, kw_only=True, eq=False)
class MappedFrame:
    """A frame after it was mapped, and the render of its view."""

    mapper: Mapper
    frame: Frame
    """With the pose that it was mapped at."""
    output: RenderOutput
    photo: Picture
    rendered: Picture


def _surface_rgb(step: MappedFrame) -> Tensor:
    mapper: Any = step.mapper
    return mapper.surface_picture(step.frame.camera, step.frame.T_WC).base.rgb


def _with_new_gaussians(picture: Picture, step: MappedFrame) -> Picture:
    model = step.mapper.gaussians
    frame = step.frame
    paint_rows(
        picture, model, model.birth_frame == frame.index, SEED_COLOUR, frame.camera, frame.T_WC
    )
    return picture


def _quadtree_seeds(step: MappedFrame) -> Picture:
    cells = step.mapper.files.quadtree_cells(step.frame)
    return _with_new_gaussians(paint_cells(step.photo, cells, by_level=False, strength=0.35), step)


def _depth_error(step: MappedFrame) -> Picture:
    return draw.depth_error_map(expected_depth_m(step.output), step.frame.depth_m)


def _states(step: MappedFrame) -> Picture:
    return state_picture(
        step.mapper.gaussians,
        step.output,
        step.frame.camera,
        step.frame.T_WC,
    )


PANELS: dict[str, tuple[str, Callable[[MappedFrame], Picture]]] = {
    "input": ("photograph", lambda step: step.photo),
    "render": ("Gaussian map, rendered", lambda step: step.rendered),
    "error": (
        "|render − photograph|, bright from 0.25",
        lambda step: draw.error_map(step.rendered, step.photo),
    ),
    "depth_error": ("|rendered depth − depth|, bright from 10 cm", _depth_error),
    "base": ("the coloured TSDF alone, holes filled", lambda step: to_uint8(_surface_rgb(step))),
    "residual": (
        "what the Gaussians add: grey is nothing",
        lambda step: to_uint8(0.5 + (step.output.rgb - _surface_rgb(step))),
    ),
    "new_gaussians": (
        "new Gaussians in red",
        lambda step: _with_new_gaussians(step.photo.copy(), step),
    ),
    "quadtree_seeds": ("quadtree cells, new Gaussians in red", _quadtree_seeds),
    "seed_causes": (
        "added for: yellow area, red depth, blue colour",
        lambda step: cause_picture(step.photo, step.mapper.gaussians, step.frame),
    ),
    "states": ("blue stable, orange unstable", _states),
}
"""The names that ``SystemDescription.panels`` can hold -> what it shows, and how it is drawn."""


def captions_of(mapper: Mapper) -> dict[str, str]:
    """The panels of a system: name -> what it shows."""
    return {name: PANELS[name][0] for name in mapper.description.panels}


def columns_for(n_panels: int) -> int:
    """Panels in a row."""
    return min(n_panels, 2) if n_panels <= 4 else 3


def mosaic(
    pictures: Mapping[str, Picture],
    captions: Mapping[str, str],
    scale: int = 1,
) -> Picture:
    """Pictures of one size, two or three in a row, with labels; ``scale`` enlarges them."""
    names = list(pictures)
    wide = columns_for(len(pictures))
    big = {name: picture.repeat(scale, 0).repeat(scale, 1) for name, picture in pictures.items()}
    labels = {name: captions[name].replace("−", "-") for name in names}
    rows = [names[i : i + wide] for i in range(0, len(names), wide)]
    return np.concatenate(
        [side_by_side([big[n] for n in row], [labels[n] for n in row]) for row in rows]
    )


def live_panels(mapper: Mapper, frame: Frame) -> dict[str, Picture]:
    """Draw the state of the map after ``mapper.step(frame)``; 25 ms at 320x240 or less.

    Args:
        mapper: Of any system; ``captions_of`` says what is drawn.
        frame: With the pose that it was mapped at.
    """
    output = mapper.render(frame.camera, frame.T_WC)
    step = MappedFrame(
        mapper=mapper,
        frame=frame,
        output=output,
        photo=to_uint8(frame.colour),
        rendered=to_uint8(output.rgb),
    )
    return {name: PANELS[name][1](step) for name in mapper.description.panels}
