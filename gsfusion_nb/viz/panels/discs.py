"""Panel of the depth of discs: where rays hit them, beside the blended depth."""

import numpy as np
import torch

from ...drawing.curves import CARD_INK, PALETTE, card_figure, figure_picture, style
from ...drawing.page import html_table
from ...drawing.pictures import Picture, colour_depth, side_by_side, to_uint8
from ...geometry import quaternion
from .disc_scene import STAGE_CAMERA, DiscScene, disc_scene
from .panel import Drawn, Number, Panel, Slider


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
