"""Pictures of a map: its colours, depth and numbers, the states of discs, why Gaussians were
added."""

import dataclasses
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ..drawing import pictures as draw
from ..drawing.pictures import AnyImage, Picture, to_uint8
from ..evaluation import expected_depth_m
from ..gaussians import GaussianModel, SurfelModel
from ..geometry import project, se3
from ..geometry.spherical_harmonics import rgb_to_sh_dc
from ..render import SurfaceView, render
from ..render.constants import NEAR_PLANE_M
from ..types import Camera, Frame, GaussianParams, RenderOutput
from ..viewer.palettes import STATE_COLOURS, palette

CAUSES = {
    1: ("new area", (250, 220, 70)),
    2: ("depth wrong", (255, 60, 60)),
    3: ("colour wrong", (70, 150, 255)),
}
"""Tag of a Gaussian from the rule ``rtg_slam`` -> why it was added, its colour: yellow, red, blue.
Over a grey picture, each is unlike the others also to eyes that lack the cones for red, green or
blue."""

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
    near_m: float = NEAR_PLANE_M,
) -> Picture:
    """What a camera sees of a map, drawn by the library's own renderer.

    Args:
        params, camera, T_WC: As for ``render``.
        paint: Colours of the Gaussians; their own by default.
        depth: Show expected depth instead, striped where there is none.
        size: Multiplies every standard deviation.
        opacity: Multiplies every opacity (clamped below 1).
        background: Behind the map, 0..1; black by default.
        near_m: Nearer Gaussians are not drawn, metres.

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
    view = render(params, camera, T_WC, near_m=near_m)
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
