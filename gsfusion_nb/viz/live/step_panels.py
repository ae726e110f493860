"""What one mapping step looks like: photograph, render, errors, and where and why new Gaussians came."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch

from ...drawing.pictures import Picture, depth_error_map, error_map, paint_cells, to_uint8
from ...drawing.side_by_side import side_by_side
from ...mapping import GSFusion
from ...mapping.systems import Mapper
from ...seeding import quadtree
from ...types import Frame
from ..splats.surfel_pictures import cause_picture, paint_rows, state_picture

_GSFUSION = {
    "input": "photograph",
    "render": "Gaussian map, rendered",
    "error": "|render − photograph|, bright from 0.25",
    "seeds": "quadtree cells, new Gaussians in red",
}
_RTG_SLAM = {
    "input": "photograph",
    "render": "Gaussian map, rendered",
    "error": "|render − photograph|, bright from 0.25",
    "depth_error": "|disc depth − depth|, bright from 10 cm",
    "states": "blue stable, orange unstable",
    "seeds": "new: green area, red depth, blue colour",
}

_DEPTH_ERROR_M = 0.1
"""What RTG-SLAM calls wrong (delta_d)."""
_SEED_COLOUR = (255, 48, 64)


def captions_of(mapper: Mapper) -> dict[str, str]:
    """The panels of a system: name -> what it shows."""
    return dict(_GSFUSION if isinstance(mapper, GSFusion) else _RTG_SLAM)


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
    """Draw the state of the maps after ``mapper.step(frame)``; 25 ms at 320x240 or less.

    Args:
        mapper: Of either system; ``captions_of`` says what is drawn.
        frame: With the pose that it was mapped at.
    """
    photo = to_uint8(frame.rgb)
    if isinstance(mapper, GSFusion):
        rendered = to_uint8(mapper.render(frame.camera, frame.T_WC).rgb)
        own = {"seeds": _cells_and_seeds(photo, mapper, frame)}
    else:
        view = mapper.surface(frame.camera, frame.T_WC)
        rendered = to_uint8(view.rgb.clamp(0, 1))
        own = {
            "depth_error": depth_error_map(view.depth_m, frame.depth_m, limit_m=_DEPTH_ERROR_M),
            "states": state_picture(mapper.gaussians, view, frame.camera, frame.T_WC),
            "seeds": cause_picture(photo, mapper.gaussians, frame),
        }
    shared = {"input": photo, "render": rendered, "error": error_map(rendered, photo)}
    return LivePanels(pictures=shared | own, captions=captions_of(mapper))


def _cells_and_seeds(photo: Picture, mapper: GSFusion, frame: Frame) -> Picture:
    settings = mapper.config.seeding
    cells = quadtree(
        torch.from_numpy(photo),
        threshold=settings.quadtree_threshold,
        min_cell_px=settings.quadtree_min_cell_px,
        contrast=settings.quadtree_contrast,
    )
    picture, model = paint_cells(photo, cells, by_level=False, strength=0.35), mapper.gaussians
    paint_rows(picture, model, model.birth_frame == frame.index, _SEED_COLOUR, frame.camera, frame.T_WC)
    return picture
