"""Pictures of one mapping step: photograph, render, errors, and where and why Gaussians were added."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from torch import Tensor

from ...drawing.pictures import Picture, depth_error_map, error_map, paint_cells, side_by_side, to_uint8
from ...evaluation import expected_depth_m
from ...mapping import Mapper
from ...types import Frame, RenderOutput
from ..splats.surfel_pictures import cause_picture, paint_rows, state_picture

_DEPTH_ERROR_M = 0.1
"""Depth error at the end of the colour scale, metres: RTG-SLAM's delta_d, above which a pixel counts as wrong."""
_SEED_COLOUR = (255, 48, 64)


@dataclass(frozen=True, kw_only=True, eq=False)
class MappedFrame:
    """A frame after it was mapped, and the render of its view."""

    mapper: Mapper
    frame: Frame
    """With the pose that it was mapped at."""
    output: RenderOutput
    photo: Picture
    rendered: Picture


@dataclass(frozen=True)
class StepPanel:
    """A picture of one step."""

    caption: str
    draw: Callable[[MappedFrame], Picture]


def _depth_error(step: MappedFrame) -> Picture:
    return depth_error_map(expected_depth_m(step.output), step.frame.depth_m, limit_m=_DEPTH_ERROR_M)


def _base(step: MappedFrame) -> Picture:
    return to_uint8(_below(step))


def _residual(step: MappedFrame) -> Picture:
    return to_uint8(0.5 + (step.output.rgb - _below(step)))


def _below(step: MappedFrame) -> Tensor:
    mapper: Any = step.mapper
    return mapper.below(step.frame.camera, step.frame.T_WC).base.rgb


def _new_gaussians(step: MappedFrame) -> Picture:
    return _with_new_gaussians(step.photo.copy(), step)


def _quadtree_seeds(step: MappedFrame) -> Picture:
    cells = step.mapper.quadtree_cells(step.frame)
    return _with_new_gaussians(paint_cells(step.photo, cells, by_level=False, strength=0.35), step)


def _states(step: MappedFrame) -> Picture:
    return state_picture(step.mapper.gaussians, step.output, step.frame.camera, step.frame.T_WC)


def _seed_causes(step: MappedFrame) -> Picture:
    return cause_picture(step.photo, step.mapper.gaussians, step.frame)


def _with_new_gaussians(picture: Picture, step: MappedFrame) -> Picture:
    model, frame = step.mapper.gaussians, step.frame
    paint_rows(picture, model, model.birth_frame == frame.index, _SEED_COLOUR, frame.camera, frame.T_WC)
    return picture


PANELS: dict[str, StepPanel] = {
    "input": StepPanel("photograph", lambda step: step.photo),
    "render": StepPanel("Gaussian map, rendered", lambda step: step.rendered),
    "error": StepPanel("|render − photograph|, bright from 0.25", lambda step: error_map(step.rendered, step.photo)),
    "depth_error": StepPanel("|rendered depth − depth|, bright from 10 cm", _depth_error),
    "base": StepPanel("the coloured TSDF alone, holes filled", _base),
    "residual": StepPanel("what the Gaussians add: grey is nothing", _residual),
    "new_gaussians": StepPanel("new Gaussians in red", _new_gaussians),
    "quadtree_seeds": StepPanel("quadtree cells, new Gaussians in red", _quadtree_seeds),
    "seed_causes": StepPanel("added for: green area, red depth, blue colour", _seed_causes),
    "states": StepPanel("blue stable, orange unstable", _states),
}
"""The names that ``Mapper.panels`` can hold."""


def captions_of(mapper: Mapper) -> dict[str, str]:
    """The panels of a system: name -> what it shows."""
    return {name: PANELS[name].caption for name in mapper.panels}


def columns_for(n_panels: int) -> int:
    """Panels in a row."""
    return 2 if n_panels <= 4 else 3


@dataclass(frozen=True, kw_only=True, eq=False)
class LivePanels:
    """Pictures of the same size by name, ``panels["render"]``."""

    pictures: Mapping[str, Picture]
    captions: Mapping[str, str]

    def __getitem__(self, name: str) -> Picture:
        return self.pictures[name]

    def mosaic(self, scale: int = 1) -> Picture:
        """All of them, two or three in a row, with labels; ``scale`` enlarges the pictures."""
        big = {name: picture.repeat(scale, 0).repeat(scale, 1) for name, picture in self.pictures.items()}
        names, wide = list(self.pictures), columns_for(len(self.pictures))
        labels = {name: text.replace("−", "-") for name, text in self.captions.items()}
        rows = [names[i : i + wide] for i in range(0, len(names), wide)]
        return np.concatenate([side_by_side([big[n] for n in row], [labels[n] for n in row]) for row in rows])


def live_panels(mapper: Mapper, frame: Frame) -> LivePanels:
    """Draw the state of the map after ``mapper.step(frame)``; 25 ms at 320x240 or less.

    Args:
        mapper: Of any system; ``captions_of`` says what is drawn.
        frame: With the pose that it was mapped at.
    """
    output = mapper.render(frame.camera, frame.T_WC)
    step = MappedFrame(
        mapper=mapper, frame=frame, output=output, photo=to_uint8(frame.colour), rendered=to_uint8(output.rgb)
    )
    pictures = {name: PANELS[name].draw(step) for name in mapper.panels}
    return LivePanels(pictures=pictures, captions=captions_of(mapper))
