"""Panels about ICP: every step of one alignment, the starting poses from which it succeeds, and
paths from above."""

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float
from torch import Tensor

from ...config import TrackingConfig
from ...drawing.curves import CARD, CARD_INK, PALETTE, card_figure, figure_picture, style
from ...drawing.live_curves import small_curves
from ...drawing.pictures import Picture, side_by_side, to_uint8
from ...geometry import depth_to_normals, se3
from ...tracking import IcpResult, Surface, associate, depth_pyramid, icp, point_to_plane
from ...types import Frame
from .ellipses import resize_to_height
from .frames import displaced_pose, point_view
from .panel import Drawn, Number, Panel, Slider, Switch
from .tsdf import distance_colours

ROWS = 270
"""Height of the two pictures of the panel, pixels."""
_REJECTED = (70, 74, 82)
_OUTSIDE = (24, 24, 28)
SUCCESS_M = 0.02
SUCCESS_DEG = 1.0
"""An alignment that ends closer than this to the true pose has succeeded."""


def frame_surface(frame: Frame, T_WC: Float[Tensor, "4 4"] | None = None) -> Surface:
    """A depth frame as the surface that another frame is aligned with (frame to frame, without a
    model)."""
    T = frame.T_WC if T_WC is None else T_WC.to(frame.depth_m)
    normal_W = se3.rotate(T, depth_to_normals(frame.camera, frame.depth_m))
    return Surface(
        depth_m=frame.depth_m,
        normal_W=normal_W,
        camera=frame.camera,
        T_WC=T,
        rgb=frame.rgb,
    )


def pose_error(
    T_WC: Float[Tensor, "4 4"],
    T_true: Float[Tensor, "4 4"],
) -> tuple[float, float]:
    """Distance of the camera centres, metres, and angle between the axes, degrees."""
    turned_deg, moved_m = se3.motion(T_WC, T_true)
    return moved_m, turned_deg


def single_level_config(config: TrackingConfig) -> TrackingConfig:
    """The same settings and number of steps, with the finest level only."""
    return dataclasses.replace(
        config, pyramid=config.pyramid[-1:], iterations=(sum(config.iterations),)
    )


def residual_level(
    r_m: Float[np.ndarray, "H W"] | Float[Tensor, "H W"], gate_m: float
) -> Float[np.ndarray, "H W"]:
    """Where on a scale of colours a residual is, -1..1: the root of its share of ``gate_m``, with
    its sign.

    A residual is never longer than the gate, so the scale ends where residuals end; its root still
    shows the noise of a few millimetres.
    """
    share = np.asarray(r_m, dtype=np.float32) / gate_m
    return np.sign(share) * np.sqrt(np.abs(share))


def residual_picture(
    frame: Frame, surface: Surface, T_WC: Float[Tensor, "4 4"], config: TrackingConfig
) -> Picture:
    """Point-to-plane residual of the finest level: red behind the surface, white on it, blue in
    front of it; full colour at ``config.max_distance_m`` (``residual_level``).

    Grey pixels fall on the surface but are rejected by distance or angle; dark ones do not fall on
    it.
    """
    level = depth_pyramid(frame.depth_m, frame.camera, config.pyramid[-1:])[0]
    pairs = associate(
        level,
        T_WC,
        surface,
        max_distance_m=config.max_distance_m,
        min_cosine=float(np.cos(np.radians(config.max_angle_deg))),
    )
    r, _ = point_to_plane(
        pairs.xyz.flatten(0, 1),
        pairs.surface_xyz.flatten(0, 1),
        pairs.surface_normal.flatten(0, 1),
    )
    r_m = r.view(pairs.inlier.shape)
    picture = distance_colours(residual_level(r_m, config.max_distance_m))
    picture[~pairs.inlier.numpy()] = _REJECTED
    picture[~pairs.overlap.numpy()] = _OUTSIDE
    return picture


def overlay_picture(frame: Frame, surface: Surface, T_WC: Float[Tensor, "4 4"]) -> Picture:
    """The frame's colours, projected with the pose, mixed with the surface's; a wrong pose shows
    double edges."""
    base = (
        np.zeros((*surface.depth_m.shape, 3), np.uint8)
        if surface.rgb is None
        else to_uint8(surface.rgb)
    )
    frame_at_pose = dataclasses.replace(frame, T_WC=T_WC.float())
    frame_points = point_view(frame_at_pose, surface.T_WC, camera=surface.camera)
    return np.where(
        frame_points.any(-1, keepdims=True),
        (base.astype(np.uint16) + frame_points) // 2,
        base,
    ).astype(np.uint8)


def _icp_picture(
    frame: Frame, surface: Surface, config: TrackingConfig, result: IcpResult, step: int
) -> Picture:
    """What ICP sees before its step number ``step``, and the curves of the whole alignment up to
    there."""
    poses = [h.T_WC for h in result.history] + [result.T_WC]
    T_WC = poses[min(step, len(poses) - 1)]
    pictures = overlay_picture(frame, surface, T_WC), residual_picture(frame, surface, T_WC, config)
    parts = [resize_to_height(p, ROWS) for p in pictures]
    most_cm = 100 * config.max_distance_m
    residual_label = f"residual: red behind, blue in front, to {most_cm:g} cm"
    top = side_by_side(parts, ["surface and frame, mixed", residual_label])
    errors = [pose_error(T, frame.T_WC) for T in poses[: step + 1]]
    rms = [h.rms_m for h in result.history] + [result.rms_m]
    series = {
        "rms residual, mm": [1000 * r for r in rms[: step + 1]],
        "position error, cm": [100 * e[0] for e in errors],
        "angle error, deg": [e[1] for e in errors],
    }
    curves = small_curves(
        series,
        n_x=sum(config.iterations) + 1,
        width=top.shape[1],
    )
    return np.concatenate([top, curves])


def icp_panel(frame: Frame, surface: Surface, config: TrackingConfig | None = None) -> Panel:
    """Sliders for the starting pose and for the step of an alignment whose true pose is
    ``frame.T_WC``.

    Args:
        frame: The frame to align.
        surface: The surface to align it with.
        config: Pyramid levels and limits of correspondences; the defaults if left out.
    """
    settings = config or TrackingConfig()
    configs = {True: settings, False: single_level_config(settings)}
    results: dict[tuple[Number, Number, bool], IcpResult] = {}

    def draw(*, step: int, sideways_cm: Number, turn_deg: Number, pyramid: bool) -> Drawn:
        key = (sideways_cm, turn_deg, pyramid)
        if key not in results:
            results.clear()
            start = displaced_pose(frame.T_WC, sideways_cm / 100, turn_deg)
            results[key] = icp(frame.depth_m, frame.camera, surface, start, configs[pyramid])
        result = results[key]
        n = len(result.history)
        off_m, off_deg = pose_error(result.T_WC, frame.T_WC)
        well = off_m < SUCCESS_M and off_deg < SUCCESS_DEG
        at = result.history[step] if step < n else None
        when = (
            f"before step {step + 1} of {n}, {at.factor} × {at.factor} px"
            if at
            else f"after all {n} steps"
        )
        fits = at or result
        words = (
            f"{when}: {fits.n_inliers:,} of {fits.n_overlap:,} "
            f"fit<br><b>{'converged' if well else 'not converged'}</b>"
            f": final error {off_m * 100:.1f} cm and {off_deg:.2f}°"
        )
        return _icp_picture(frame, surface, configs[pyramid], result, min(step, n)), words

    controls = {
        "step": Slider(
            value=0,
            low=0,
            high=sum(settings.iterations),
            step=1,
            label="step",
        ),
        "sideways_cm": Slider(
            value=15,
            low=-60,
            high=60,
            step=1,
            label="start: right cm",
        ),
        "turn_deg": Slider(
            value=-5,
            low=-20,
            high=20,
            step=1,
            label="start: turn °",
        ),
        "pyramid": Switch(value=True, label="coarse to fine"),
    }
    return Panel(draw, controls, name="icp", text="ICP, step by step")


def convergence_basin(
    frame: Frame,
    surface: Surface,
    sideways_m: Sequence[float],
    turns_deg: Sequence[float],
    config: TrackingConfig | None = None,
) -> Float[np.ndarray, "R C"]:
    """Final distance from the true pose ``frame.T_WC``, metres; rows are turns, columns sideways
    displacements."""
    config = config or TrackingConfig()
    rows = []
    for turn in turns_deg:
        starts = [displaced_pose(frame.T_WC, aside, turn) for aside in sideways_m]
        ends = [icp(frame.depth_m, frame.camera, surface, T, config).T_WC for T in starts]
        rows.append([pose_error(T, frame.T_WC)[0] for T in ends])
    return np.array(rows)


def basin_picture(
    errors_m: Float[np.ndarray, "R C"], sideways_m: Sequence[float], turns_deg: Sequence[float]
) -> Picture:
    """Blue: from this start ICP ended within 2 cm of the true pose; yellow to red: up to 20 cm and
    more."""
    from matplotlib.colors import ListedColormap

    R, C = errors_m.shape
    figure, (axes,) = card_figure(30 * C + 80, 30 * R + 80)
    worse = np.log(np.maximum(errors_m, 1e-4) / SUCCESS_M) / np.log(10)
    stops = (
        np.linspace(
            (244, 205, 90),
            (209, 73, 91),
            32,
        )
        / 255
    )
    axes.pcolormesh(
        worse,
        cmap=ListedColormap(stops).with_extremes(under="#3d85c6"),
        vmin=0,
        vmax=1,
        edgecolor=CARD,
    )
    x = (0, C // 2, C - 1)
    y = (0, R // 2, R - 1)
    axes.set_xticks([j + 0.5 for j in x], [f"{sideways_m[j] * 100:+.0f} cm" for j in x])
    axes.set_yticks([i + 0.5 for i in y], [f"{turns_deg[i]:+.0f}°" for i in y])
    style(
        axes,
        title=f"{float((errors_m < SUCCESS_M).mean()):.0%} of the starts converge",
        ink=CARD_INK,
    )
    return figure_picture(figure)


def path_picture(
    paths: Mapping[str, Sequence[Tensor] | Float[Tensor, "N 4 4"]],
    *,
    links: Sequence[tuple[int, int]] = (),
    linked: str = "",
    width: int = 400,
) -> Picture:
    """Camera paths from above, each with a dot at its start and a ring at its end.

    Args:
        paths: Name -> camera-to-world poses, all in one world with z up.
        links: Pairs of rows of the path ``linked`` to join by thin lines (loops).
        linked: Name of that path.
        width: Of the picture, pixels.
    """
    figure, (axes,) = card_figure(width, width)
    xy = {name: np.array([T[:2, 3].tolist() for T in path]) for name, path in paths.items()}
    for pair in links:
        axes.plot(
            *xy[linked][list(pair)].T,
            color=CARD_INK,
            linewidth=0.6,
            alpha=0.5,
        )
    for (name, points), ink in zip(xy.items(), PALETTE, strict=False):
        axes.plot(*points.T, color=ink, label=name)
        axes.plot(*points[0], "o", color=ink)
        axes.plot(
            *points[-1],
            "o",
            color=ink,
            fillstyle="none",
            markersize=10,
        )
    axes.set_aspect("equal", adjustable="datalim")
    style(axes, x="x, m", y="y, m", ink=CARD_INK)
    figure.legend(
        loc="outside lower center", ncols=2, frameon=False, labelcolor=CARD_INK, fontsize=8
    )
    return figure_picture(figure)
