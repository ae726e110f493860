"""What one mapping step looks like: photograph, render, error, and where the quadtree put new Gaussians."""

from dataclasses import dataclass

import numpy as np
import torch

from ..geometry import camera, se3
from ..mapping import GSFusion
from ..seeding import quadtree
from ..types import Frame
from .figures import Picture, error_map, paint_cells, side_by_side, to_uint8

CAPTIONS = {
    "input": "photograph",
    "render": "Gaussian map, rendered",
    "error": "|render − photograph|, bright from 0.25",
    "seeds": "quadtree cells, new Gaussians in red",
}
"""Panel -> what it shows."""

_SEED_COLOUR = (255, 48, 64)


@dataclass(frozen=True, kw_only=True, eq=False)
class LivePanels:
    """Four pictures of the same size."""

    input: Picture
    render: Picture
    error: Picture
    seeds: Picture

    def mosaic(self) -> Picture:
        """All four, two by two, with labels."""
        rows = (("input", "render"), ("error", "seeds"))
        labels = {name: text.replace("−", "-") for name, text in CAPTIONS.items()}
        return np.concatenate(
            [side_by_side([getattr(self, n) for n in names], [labels[n] for n in names]) for names in rows]
        )


def live_panels(mapper: GSFusion, frame: Frame) -> LivePanels:
    """Draw the state of the maps after ``mapper.step(frame)``; about 25 ms at 320x240."""
    photo = to_uint8(frame.rgb)
    rendered = to_uint8(mapper.render(frame.camera, frame.T_WC).rgb)
    settings = mapper.config.seeding
    cells = quadtree(
        torch.from_numpy(photo),
        threshold=settings.quadtree_threshold,
        min_cell_px=settings.quadtree_min_cell_px,
        contrast=settings.quadtree_contrast,
    )
    lined = paint_cells(photo, cells, by_level=False, strength=0.35)
    return LivePanels(
        input=photo,
        render=rendered,
        error=error_map(rendered, photo),
        seeds=_with_seeds(lined, mapper, frame),
    )


def _with_seeds(picture: Picture, mapper: GSFusion, frame: Frame) -> Picture:
    """Dots of two by two pixels where the Gaussians born at this frame lie now."""
    model = mapper.gaussians
    xyz_W = model.params.xyz_W[model.birth_frame == frame.index]
    xyz_C = se3.apply(se3.inverse(frame.T_WC.to(xyz_W)), xyz_W)
    uv = camera.project(frame.camera, xyz_C[xyz_C[:, 2] > 0]).cpu().numpy()
    uv = np.floor(uv[np.isfinite(uv).all(1)]).clip(-9, 1e6).astype(int)
    for dx in (0, 1):
        for dy in (0, 1):
            x, y = uv[:, 0] + dx, uv[:, 1] + dy
            inside = (x >= 0) & (y >= 0) & (x < picture.shape[1]) & (y < picture.shape[0])
            picture[y[inside], x[inside]] = _SEED_COLOUR
    return picture
