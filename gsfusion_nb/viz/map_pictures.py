"""Pictures of a map: its colours, depth and numbers, the states of discs, one mapping step."""

import dataclasses
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ..drawing import pictures as draw
from ..drawing.pictures import AnyImage, Picture, paint_cells, side_by_side, to_uint8
from ..evaluation import expected_depth_m
from ..gaussians import GaussianModel, SurfelModel
from ..geometry import project, se3
from ..geometry.spherical_harmonics import rgb_to_sh_dc
from ..mapping import Mapper
from ..render import SurfaceView, render
from ..types import Camera, Frame, GaussianParams, RenderOutput
from ..viewer.palettes import STATE_COLOURS, palette

CAUSES = {
    1: ("new area", (60, 210, 90)),
    2: ("depth wrong", (255, 60, 60)),
    3: ("colour wrong", (70, 150, 255)),
}
"""Tag of a Gaussian from the rule ``rtg_slam`` -> why it was added, its colour."""

_NOTHING = (24, 24, 28)


_BAR_PX = 14


@dataclass(frozen=True, kw_only=True, eq=False)
class Paint:
    """One number for each Gaussian, shown as its colour."""

    values: Float[Tensor, " N"]
    low: float
    """Number of the first colour."""
    high: float
    """Number of the last one."""
    palette: str = "viridis"

    def on(self, params: GaussianParams) -> GaussianParams:
        """The same Gaussians in these colours, the same from every side."""
        level = (
            ((self.values - self.low) / max(self.high - self.low, 1e-9) * 255)
            .round()
            .clamp(0, 255)
            .long()
        )
        colours = torch.from_numpy(palette(self.palette)).to(params.sh) / 255
        return dataclasses.replace(
            params, sh=rgb_to_sh_dc(colours[level.to(colours.device)])[:, None]
        )


def map_picture(
    params: GaussianParams,
    camera: Camera,
    T_WC: Float[Tensor, "4 4"],
    *,
    paint: Paint | None = None,
    depth: bool = False,
    size: float = 1.0,
    opacity: float = 1.0,
    background: Float[Tensor, "3"] | None = None,
) -> Picture:
    """What a camera sees of a map, drawn by the library's own renderer.

    Args:
        params, camera, T_WC: As for ``render``.
        paint: Colours of the Gaussians; their own by default.
        depth: Show expected depth instead, striped where there is none.
        size: Multiplies every standard deviation.
        opacity: Multiplies every opacity (clamped below 1).
        background: Behind the map, 0..1; black by default.

    Returns:
        The picture, with the colours' scale in the lower left corner for ``paint`` and ``depth``.
    """
    if paint is not None:
        params = paint.on(params)
    if size != 1 or opacity != 1:
        o = (params.opacity_logit.sigmoid() * opacity).clamp(1e-6, 1 - 1e-6)
        log_size = torch.tensor(size).log().item()
        params = dataclasses.replace(
            params, log_scale=params.log_scale + log_size, opacity_logit=o.logit()
        )
    view = render(params, camera, T_WC)
    if depth:
        return depth_picture(view)
    backdrop = 0 if background is None else (1 - view.alpha[..., None]) * background.to(view.rgb)
    picture = to_uint8(view.rgb + backdrop)
    if paint is None or paint.palette == "state":
        return picture
    return _with_scale(picture, palette(paint.palette), f"{paint.low:.3g}", f"{paint.high:.3g}")


def depth_picture(view: RenderOutput) -> Picture:
    """Expected depth of a rendered view as colour, with its scale."""
    depth = expected_depth_m(view)
    low_m, high_m = draw.depth_range_m(depth)
    return _with_scale(
        draw.colour_depth(depth, low_m, high_m),
        palette("turbo"),
        f"{low_m:.1f} m",
        f"{high_m:.1f} m",
    )


def _with_scale(picture: Picture, colours: np.ndarray, low: str, high: str) -> Picture:
    """A colour bar with the values at its ends, over a dark strip in the lower left corner."""
    height, width = picture.shape[:2]
    font = cv2.FONT_HERSHEY_SIMPLEX
    size = 0.4
    bar = min(110, width // 3)
    ends = [cv2.getTextSize(text, font, size, 1)[0][0] for text in (low, high)]
    total = bar + sum(ends) + 20
    if total > width or height < 2 * _BAR_PX:
        return picture
    top = height - _BAR_PX - 4
    picture[top:, :total] = 24
    x = ends[0] + 10
    ramp = colours[np.linspace(0, 255, bar).astype(int)]
    picture[top + 4 : height - 4, x : x + bar] = ramp[None]
    for text, at in ((low, 4), (high, x + bar + 6)):
        cv2.putText(
            picture,
            text,
            (at, height - 5),
            font,
            size,
            (235, 235, 235),
            1,
            cv2.LINE_AA,
        )
    return picture


def state_picture(
    model: SurfelModel, view: SurfaceView | RenderOutput, camera: Camera, T_WC: Tensor
) -> Picture:
    """Every pixel in the colour of the state of the disc that it hits, shaded by the render;
    transparent rows as dots.

    Args:
        model: The map.
        view: What a camera there sees, from ``RTGSLAM.render`` or ``RTGSLAM.surface``.
        camera, T_WC: The camera and pose that it is seen from.
    """
    table = np.array(
        [STATE_COLOURS["unstable_opaque"], STATE_COLOURS["stable_opaque"], _NOTHING], np.float32
    )
    assert view.hit_index is not None
    disc = view.hit_index.cpu()
    state = (
        torch.where(
            disc >= 0,
            model.state.cpu()[disc.clamp_min(0).long()].long(),
            2,
        )
        if len(model)
        else disc * 0 + 2
    )
    light = view.rgb.cpu().clamp(0, 1).mean(-1).numpy()
    shade = np.where(state.numpy() == 2, 1.0, 0.55 + 0.45 * light)
    picture = (table[state.numpy()] * shade[..., None]).astype(np.uint8)
    for name, stable in (("unstable_transparent", False), ("stable_transparent", True)):
        paint_rows(
            picture,
            model,
            model.is_transparent & (model.is_stable == stable),
            STATE_COLOURS[name],
            camera,
            T_WC,
        )
    return picture


def cause_picture(photo: AnyImage, model: SurfelModel, frame: Frame) -> Picture:
    """The photograph in grey, with the Gaussians added at this frame as dots in the colour of their
    cause."""
    grey = to_uint8(photo).mean(-1, keepdims=True)
    picture = np.repeat(
        (60 + 0.55 * grey).astype(np.uint8),
        3,
        axis=-1,
    )
    born = model.birth_frame == frame.index
    for tag, (_, ink) in CAUSES.items():
        paint_rows(
            picture,
            model,
            born & (model.tag == tag),
            ink,
            frame.camera,
            frame.T_WC,
        )
    return picture


def paint_rows(
    picture: Picture,
    model: GaussianModel,
    rows: Bool[Tensor, " N"],
    ink: tuple[int, ...],
    camera: Camera,
    T_WC: Tensor,
) -> None:
    """Draw a dot of two by two pixels at the centre of each of the given Gaussians, in place."""
    xyz_W = model.params.xyz_W[rows]
    xyz_C = se3.apply(se3.inverse(T_WC.to(xyz_W)), xyz_W)
    paint_points(picture, project(camera, xyz_C[xyz_C[:, 2] > 0]), ink)


def paint_points(
    picture: Picture,
    uv: Float[Tensor, "N 2"],
    ink: tuple[int, ...],
) -> None:
    """Draw a dot of two by two pixels at each point, in place; ``uv`` is where its upper left pixel
    is."""
    at = uv.cpu().numpy()
    at = np.floor(at[np.isfinite(at).all(1)]).clip(-9, 1e6).astype(int)
    for dx in (0, 1):
        for dy in (0, 1):
            x = at[:, 0] + dx
            y = at[:, 1] + dy
            in_picture = (x >= 0) & (y >= 0) & (x < picture.shape[1]) & (y < picture.shape[0])
            picture[y[in_picture], x[in_picture]] = ink


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
        "added for: green area, red depth, blue colour",
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
