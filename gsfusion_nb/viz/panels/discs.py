"""Panels about surfaces that carry Gaussians: disc depth, the masks of RTG-SLAM's Eq. 6, GPS-SLAM's
two parts."""

import dataclasses
from collections.abc import Mapping

import numpy as np
import torch
from jaxtyping import Float
from markupsafe import Markup
from torch import Tensor

from ...config import DiscConfig
from ...drawing.curves import CARD_INK, PALETTE, card_figure, figure_picture, style
from ...drawing.page import html_table
from ...drawing.pictures import AnyImage, Picture, colour_depth, error_map, side_by_side, to_uint8
from ...gaussians.surfels import OPAQUE
from ...geometry import quaternion
from ...geometry.spherical_harmonics import rgb_to_sh_dc
from ...render import SurfaceView, view_surface
from ...seeding.rules.rtg_slam import adding_masks
from ...types import Camera, Frame, GaussianParams
from ..map_pictures import CAUSES
from .panel import Choice, Drawn, Number, Panel, Slider

STAGE_CAMERA = Camera(
    width=96,
    height=60,
    fx=80.0,
    fy=80.0,
    cx=48.0,
    cy=30.0,
)
NEAR_M = 1.2
"""The right edge of the front board is at x = 0 and this far away, metres."""
MID_AIR_M = 0.03
_HALF_M = 0.7
_ROWS_M = 0.8


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class DiscScene:
    """Two boards covered with discs, seen from the origin, and what a camera sees of them."""

    params: GaussianParams
    truth_m: Float[Tensor, "H W"]
    """z-depth of the boards."""
    planes_m: tuple[Float[Tensor, "H W"], ...]
    """z-depth of the planes that the boards lie in."""
    disc_m: Float[Tensor, "H W"]
    """Depth of the discs that the rays hit (Eq. 4-5); 0 where there is none."""
    blended_m: Float[Tensor, "H W"]
    """sum of w_k z_k / alpha."""
    rgb: Float[Tensor, "H W 3"]

    def errors_m(self, name: str) -> Float[Tensor, " M"]:
        """|depth - truth| on the board where there is a depth; ``name`` is "disc_m" or
        "blended_m"."""
        depth = getattr(self, name)
        return (depth - self.truth_m)[(depth > 0) & (self.truth_m == self.planes_m[0])].abs()

    def in_mid_air(self, name: str) -> float:
        """Share of the depths that are more than 3 cm from every surface."""
        depth = getattr(self, name)
        distance_m = torch.stack([(depth - plane).abs() for plane in self.planes_m]).amin(0)
        return float((distance_m[depth > 0] > MID_AIR_M).float().mean())


def disc_scene(
    *,
    lean_deg: float | int = 30,
    gap_m: float | int = 0.6,
    spacing_m: float | int = 0.1,
    opaque_alpha: float = 0.3,
) -> DiscScene:
    """A tilted board in front of a wall, both covered with discs of standard deviation spacing /
    1.5.

    Args:
        lean_deg: Rotation of the front board about the vertical, degrees.
        gap_m: Distance of the wall behind it, metres; 0: only the board.
        spacing_m: Distance of neighbouring discs, metres.
        opaque_alpha: A ray hits a disc where its alpha is at least this.
    """
    camera = STAGE_CAMERA
    T_WC = torch.eye(4)
    lean = np.radians(float(lean_deg))
    front = _board(
        lean,
        NEAR_M,
        (-_HALF_M, 0.0 if gap_m > 0 else _HALF_M),
        float(spacing_m),
        (0.93, 0.62, 0.36),
    )
    parts = [front]
    if gap_m > 0:
        parts.append(
            _board(
                0.0,
                NEAR_M + gap_m,
                (-1.4, 1.4),
                float(spacing_m) * 1.3,
                (0.36, 0.55, 0.75),
            )
        )
    params = GaussianParams(**{k: torch.cat([vars(p)[k] for p in parts]) for k in vars(front)})
    config = DiscConfig(opaque_alpha=opaque_alpha, min_cosine=0.17, max_offset=3.0)
    view = view_surface(params, camera, T_WC, config)
    blended_view = view_surface(params, camera, T_WC, dataclasses.replace(config, depth="blended"))
    planes = _planes(camera, lean, float(gap_m))
    return DiscScene(
        params=params,
        truth_m=_truth(camera, lean, planes),
        planes_m=planes,
        disc_m=view.depth_m,
        blended_m=blended_view.depth_m,
        rgb=view.rgb,
    )


def disc_panel() -> Panel:
    """Sliders over ``disc_scene``: picture, both depths, and the middle row of pixels from
    above."""

    def draw(*, lean_deg: Number, gap_m: Number, spacing_m: Number, opaque_alpha: float) -> Drawn:
        scene = disc_scene(
            lean_deg=lean_deg, gap_m=gap_m, spacing_m=spacing_m, opaque_alpha=opaque_alpha
        )
        return disc_scene_picture(scene), _scene_words(scene)

    controls = {
        "lean_deg": Slider(
            value=30,
            low=0,
            high=75,
            step=1,
            label="board tilt, °",
        ),
        "gap_m": Slider(
            value=0.6,
            low=0.0,
            high=1.2,
            step=0.05,
            label="wall behind, m",
        ),
        "spacing_m": Slider(
            value=0.1,
            low=0.05,
            high=0.3,
            step=0.01,
            label="disc spacing, m",
        ),
        "opaque_alpha": Slider(
            value=0.3,
            low=0.1,
            high=0.95,
            step=0.05,
            label="hit from δ_α",
        ),
    }
    return Panel(draw, controls, name="disc", text="disc depth against blended depth")


def disc_scene_picture(scene: DiscScene) -> Picture:
    """Render, disc depth and blended depth in a row; below, the middle row of pixels as points seen
    from above."""
    far_m = _far_m(scene) + 0.1
    images = [
        to_uint8(scene.rgb),
        *(colour_depth(d, 0.5, far_m) for d in (scene.disc_m, scene.blended_m)),
    ]
    images = [i.repeat(3, 0).repeat(3, 1) for i in images]
    top = side_by_side(
        images, ["render", "disc depth (Eq. 5)", f"blended; blue 0.5 m, red {far_m:.1f} m"]
    )
    return np.concatenate([top, disc_scene_plan(scene, top.shape[1])])


def disc_scene_plan(scene: DiscScene, width: int, height: int = 300) -> Picture:
    """The scene from above, the camera below: discs near the middle row, the depths of its rays as
    points."""
    figure, (axes,) = card_figure(width, height)
    far_m = _far_m(scene)
    camera = STAGE_CAMERA
    x_over_z = (np.arange(camera.width) + 0.5 - camera.cx) / camera.fx
    R = quaternion.to_matrix(scene.params.quat)
    scales = scene.params.log_scale.exp()
    in_slab = scene.params.xyz_W[:, 1].abs() < 0.6 * float(scales.max())
    centre = scene.params.xyz_W[in_slab]
    side = R[in_slab, :, 0] * scales[in_slab, :1]
    ends = torch.stack([centre - side, centre + side])[..., [0, 2]].numpy()
    axes.plot(
        ends[..., 0],
        ends[..., 1],
        color=CARD_INK,
        alpha=0.4,
        linewidth=4,
    )
    for depth, name, ink, size in (
        (scene.blended_m, "blended depth", PALETTE[1], 4),
        (scene.disc_m, "disc depth", PALETTE[0], 4),
        (scene.truth_m, "truth", CARD_INK, 1.5),
    ):
        z = depth[camera.height // 2].numpy()
        in_plan = (z > 0) & (z <= far_m + 0.05)
        axes.plot(
            (x_over_z * z)[in_plan],
            z[in_plan],
            "o",
            color=ink,
            markersize=size,
            label=name,
        )
    low = max(0.0, float(scene.truth_m[scene.truth_m > 0].min()) - 0.25)
    axes.set(
        ylim=(low, far_m + 0.05),
        xlim=(-0.6 * far_m, 0.6 * far_m),
    )
    axes.set_aspect("equal", adjustable="box")
    style(
        axes,
        x="x, m",
        y="z, m",
        title="from above, middle row of pixels; the camera is below",
        ink=CARD_INK,
    )
    axes.legend(frameon=False, labelcolor=CARD_INK, fontsize=8)
    return figure_picture(figure)


def _far_m(scene: DiscScene) -> float:
    """Largest depth that is drawn: some rays meet a tilted plane far behind its last disc, or
    never."""
    return min(
        float(scene.truth_m.max()),
        float(scene.params.xyz_W[:, 2].max()),
    )


def _scene_words(scene: DiscScene) -> str:
    rows = []
    for name, label in (("disc_m", "disc"), ("blended_m", "blended")):
        error = scene.errors_m(name)
        median = f"{float(error.median()) * 100:.2f} cm" if len(error) else "-"
        coverage = float((getattr(scene, name) > 0).float().mean())
        rows.append((label, median, f"{scene.in_mid_air(name):.1%}", f"{coverage:.0%}"))
    heads = ("depth", "error on board", "in mid-air", "covered")
    return html_table(rows, heads=heads, head_style="white-space:nowrap; padding-right:10px")


def _board(
    lean: float,
    z_m: float,
    x_m: tuple[float, float],
    spacing_m: float,
    rgb: tuple[float, ...],
) -> GaussianParams:
    """Discs on a plane through (0, 0, z) that is turned by ``lean`` about the vertical; the left
    side is farther."""
    u = torch.arange(x_m[0] + spacing_m / 2, x_m[1], spacing_m)
    v = torch.arange(-_ROWS_M, _ROWS_M + spacing_m / 2, spacing_m)
    u, v = (a.flatten() for a in torch.meshgrid(u, v, indexing="ij"))
    direction = torch.tensor(
        [np.cos(lean), 0.0, -np.sin(lean)],
        dtype=torch.float32,
    )
    normal = torch.tensor(
        [-np.sin(lean), 0.0, -np.cos(lean)],
        dtype=torch.float32,
    )
    xyz = (
        u[:, None] * direction
        + v[:, None] * torch.tensor([0.0, 1.0, 0.0])
        + torch.tensor([0.0, 0.0, z_m])
    )
    n = len(u)
    checks = 0.82 + 0.18 * ((u / spacing_m).round() + (v / spacing_m).round()).remainder(2)
    colour = checks[:, None] * torch.tensor(rgb)
    z_axis = torch.tensor([0.0, 0.0, 1.0]).expand(n, 3)
    sigma = spacing_m / 1.5
    return GaussianParams(
        xyz_W=xyz,
        log_scale=torch.tensor([sigma, sigma, 0.1 * sigma]).log().expand(n, 3).clone(),
        quat=quaternion.shortest_arc(z_axis, normal.expand(n, 3)),
        opacity_logit=torch.full((n,), float(torch.logit(torch.tensor(OPAQUE)))),
        sh=rgb_to_sh_dc(colour)[:, None],
    )


def _planes(
    camera: Camera,
    lean: float,
    gap_m: float,
) -> tuple[Float[Tensor, "H W"], ...]:
    """z-depth of the board's plane, x tan(lean) + z = z0, and of the wall's along the rays."""
    x = ((torch.arange(camera.width) + 0.5 - camera.cx) / camera.fx).expand(camera.height, -1)
    board = (NEAR_M / (1 + x * float(np.tan(lean)))).contiguous()
    return (board, torch.full_like(board, NEAR_M + gap_m)) if gap_m > 0 else (board,)


def _truth(
    camera: Camera, lean: float, planes: tuple[Float[Tensor, "H W"], ...]
) -> Float[Tensor, "H W"]:
    """z-depth of the boards: the front one is between x = -0.7 cos(lean) and 0 if there is a
    wall."""
    board = planes[0]
    wall = planes[-1]
    x_m = (torch.arange(camera.width) + 0.5 - camera.cx) / camera.fx * board
    on_board = (board > 0) & (x_m <= 0) & (x_m >= -_HALF_M * float(np.cos(lean)))
    return torch.where(on_board, torch.minimum(board, wall), wall)


def masks_by_cause(
    view: SurfaceView,
    frame: Frame,
    min_transmittance: float,
    depth_error_m: float,
    colour_error: float,
) -> dict[int, Tensor]:
    """The pixels where Gaussians are added, by cause (RTG-SLAM Eq. 6), keys as in ``CAUSES``; no
    pixel is in two.

    A pixel without a disc has no depth error, as in the library's default.
    """
    seen_m = torch.where(view.depth_m > 0, view.depth_m, frame.depth_m)
    limits = (min_transmittance, depth_error_m, colour_error)
    surface, colour = adding_masks(
        view.transmittance, seen_m, frame.depth_m, view.rgb, frame.rgb, *limits
    )
    unseen = view.transmittance > min_transmittance
    return {1: surface & unseen, 2: surface & ~unseen, 3: colour}


def disc_adding_panel(view: SurfaceView, frame: Frame) -> Panel:
    """Sliders for the thresholds of RTG-SLAM's Eq. 6 over a frame that the map has not seen yet.

    Args:
        view: The map, rendered at the frame's pose.
        frame: The new frame.
    """

    photo = to_uint8(frame.colour)
    render_u8 = to_uint8(view.rgb)

    def draw(*, min_transmittance: float, depth_error_m: float, colour_error: float) -> Drawn:
        masks = masks_by_cause(view, frame, min_transmittance, depth_error_m, colour_error)
        picture = np.repeat(
            0.25 * 255 + 0.5 * photo.mean(-1, keepdims=True),
            3,
            axis=-1,
        )
        count = Markup('<span class="gsnb-adding-{}">{:,} pixels</span>')
        rows = []
        for cause, mask in masks.items():
            share = f"{float(mask.float().mean()):.1%}"
            rows.append((CAUSES[cause][0], count.format(cause, int(mask.sum())), share))
            picture[mask.numpy()] = 0.35 * picture[mask.numpy()] + 0.65 * np.array(CAUSES[cause][1])
        pictures = [photo, render_u8, error_map(render_u8, photo), picture.astype(np.uint8)]
        k = max(1, round(300 / picture.shape[1]))
        pictures = [p.repeat(k, 0).repeat(k, 1) for p in pictures]
        top = side_by_side(pictures[:2], ["new frame", "map so far"])
        low = side_by_side(pictures[2:], ["colour error", "green new, red depth, blue colour"])
        return np.concatenate([top, low]), html_table(rows)

    controls = {
        "min_transmittance": Slider(
            value=0.5,
            low=0.05,
            high=0.95,
            step=0.05,
            label="δ_T",
        ),
        "depth_error_m": Slider(
            value=0.1,
            low=0.01,
            high=0.3,
            step=0.01,
            label="δ_d, m",
        ),
        "colour_error": Slider(
            value=0.1,
            low=0.01,
            high=0.3,
            step=0.01,
            label="δ_c",
        ),
    }
    return Panel(draw, controls, name="adding", text="the masks of Eq. 6")


def surface_panel(
    pictures: Mapping[str, tuple[AnyImage, AnyImage]],
    photo: AnyImage,
    *,
    label: str = "voxels",
    scale: int = 2,
) -> Panel:
    """A choice of maps; of each, the surface, what the Gaussians add (grey: nothing), the sum, and
    its error.

    Args:
        pictures: Name of the map -> its surface and its whole picture, of the size of ``photo``. At
            least one.
        photo: The photograph that all of them should look like.
        label: What the names are.
        scale: Screen pixels for each pixel.
    """
    names = list(pictures)

    def draw(choice: str) -> Drawn:
        surface, whole = (to_uint8(x) for x in pictures[choice])
        correction = ((whole.astype(int) - surface) + 128).clip(0, 255).astype("uint8")
        parts = [
            part.repeat(scale, 0).repeat(scale, 1)
            for part in (surface, correction, whole, error_map(whole, photo))
        ]
        words = (
            f"{label} {choice}: the surface alone, what the Gaussians add, the sum, and its error"
        )
        return side_by_side(
            parts, ["surface", "added by Gaussians", "sum", "|sum - photograph|"]
        ), words

    controls = {"choice": Choice(value=names[-1], options=names, label=label)}
    return Panel(draw, controls, name="surface", text="Surface, corrections and sum")
