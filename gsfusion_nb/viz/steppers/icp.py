"""A stepper through one iteration of ICP."""

import dataclasses
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ...config import TrackingConfig
from ...drawing.curves import BETWEEN, PALETTE, style
from ...errors import ArgumentError
from ...tracking import Surface, align, depth_pyramid, icp_system
from ...tracking.icp_step import solve_step
from ...types import Camera
from ..panels.icp import residual_level
from ..panels.tsdf import distance_colours
from .recording import Line, Recording, record
from .stepper import Step, Stepper, text_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure


ICP_WATCH = {
    icp_system: {
        "associate": (
            "xyz",
            "u",
            "v",
            "row",
            "column",
            "surface_xyz",
            "surface_normal",
            "overlap",
            "is_near",
            "is_aligned",
            "inlier",
            "max_distance_m",
        ),
        "point_to_plane": ("r", "J"),
        "icp_system": ("r", "J", "w", "rows"),
    },
    align: {"align": ("T_WC", "system", "step")},
    solve_step: {"solve_step": ("H", "b", "eigenvalues", "is_determined", "y")},
}


def icp_stepper(
    depth_m: Float[Tensor, "H W"],
    camera: Camera,
    surface: Surface,
    T_WC_start: Float[Tensor, "4 4"],
    config: TrackingConfig | None = None,
    *,
    factor: int = 4,
    pixels: int = 3,
) -> Stepper:
    """Press Next through one iteration of ``align``: some pixels one by one, then the sums over all
    of them.

    Left: the residual of every pixel that passes the gates, red behind the surface and blue in
    front of it; the pixel in question is framed. Right: its point p, its partner q, and the plane
    of q, when the partner is known. Below: H, when it is.

    Args:
        depth_m, camera: The frame.
        surface: The surface to align it with.
        T_WC_start: Camera-to-world pose before the iteration.
        config: Limits of correspondences and damping; the defaults if left out.
        factor: Reduction of the frame; about 40 x 30 pixels are left then of one of 160 x 120.
        pixels: How many pixels are shown one by one; the last of them is one that a gate refuses,
            if there is any.

    Raises:
        ValueError: no pixel of the frame passes the gates.
    """
    one_iteration = dataclasses.replace(
        config or TrackingConfig(),
        pyramid=(factor,),
        iterations=(1,),
    )
    levels = depth_pyramid(depth_m, camera, one_iteration.pyramid)
    recording = record(lambda: align(levels, surface, T_WC_start, one_iteration), ICP_WATCH)
    gate = recording.at("inlier = overlap & is_near & is_aligned")[0]
    if not bool(gate["inlier"].any()):
        raise ArgumentError("no pixel of the frame passes the gates at this pose")
    steps = [step for at in _some_pixels(gate, pixels) for step in _of_pixel(recording, at)]
    steps += _sums(recording)
    shape = tuple(gate["inlier"].shape)
    label = f"One iteration of ICP, {shape[1]} x {shape[0]} pixels"
    has_partner = [k for k, step in enumerate(steps) if step.scene["q"] is not None]
    has_sums = [k for k, step in enumerate(steps) if step.scene["H"] is not None]
    return Stepper(
        steps,
        _icp_picture,
        name="icp",
        label=label,
        size=(450, 350),
        stills=[has_partner[0], has_sums[0], len(steps) - 1],
    )


def _some_pixels(gate: Line, count: int) -> list[tuple[int, int]]:
    """Evenly spaced inliers, and a pixel that meets the surface but is refused."""
    inliers = gate["inlier"].nonzero()
    outliers = (gate["overlap"] & ~gate["inlier"]).nonzero()
    n = count - bool(len(outliers))
    pixels = [inliers[int((k + 0.5) * len(inliers) / n)] for k in range(n)]
    pixels += [outliers[len(outliers) // 2]] if len(outliers) else []
    return [(int(row), int(column)) for row, column in pixels]


def _residuals(recording: Recording, nth: int) -> dict[str, Any]:
    """Of a scene: point-to-plane distances, metres, of the pixels that pass the gates in the n-th
    system, NaN elsewhere; and the gate, metres."""
    gate = recording.at("inlier = overlap & is_near & is_aligned")[nth]
    residual_m = torch.full(gate["inlier"].shape, torch.nan)
    residual_m[gate["inlier"]] = recording.at("r = ((xyz - surface_xyz)")[nth]["r"].float()
    return {"residual_m": residual_m.numpy(), "gate_m": gate["max_distance_m"]}


def _of_pixel(recording: Recording, at: tuple[int, int]) -> list[Step]:
    points = recording.at("xyz = se3.apply(T, depth_to_points")[0]
    falls = recording.at("column = u.where")[0]
    partner = recording.at("surface_normal = surface.normal_W")[0]
    gate = recording.at("inlier = overlap &")[0]
    r_line = recording.at("r = ((xyz - surface_xyz)")[0]
    J_line = recording.at("J = torch.cat([surface_normal")[0]
    p = points["xyz"][at]
    q = partner["surface_xyz"][at]
    n = partner["surface_normal"][at]
    scene = {
        **_residuals(recording, 0),
        "pixel": at,
        "p": p.numpy(),
        "q": None,
        "n": None,
        "H": None,
    }
    whole = scene | {"q": q.numpy(), "n": n.numpy()}
    name = f"Pixel ({at[1]}, {at[0]})"
    steps = [
        Step(
            points,
            f"{name}: its point p, moved with the assumed pose.",
            [("p", text_of(p) + " m")],
            scene,
        ),
        Step(
            falls,
            "p is projected into the camera of the surface: the pixel on which it falls.",
            [
                ("u, v", f"{float(falls['u'][at]):.2f}, {float(falls['v'][at]):.2f}"),
                ("row, column", f"{int(falls['row'][at])}, {int(falls['column'][at])}"),
            ],
            scene,
        ),
        Step(
            partner,
            "The surface's point q and normal n at that pixel: its partner, a guess.",
            [
                ("q", text_of(q) + " m"),
                ("n", text_of(n, 3)),
                ("|p − q|", f"{1000 * float((p - q).norm()):.1f} mm"),
            ],
            whole,
        ),
    ]
    is_near, is_aligned, inlier = (
        bool(gate[key][at]) for key in ("is_near", "is_aligned", "inlier")
    )
    verdict = "this pair is used" if inlier else "this pair is refused and has no residual"
    gates = [
        ("distance", f"{'within' if is_near else 'above'} {100 * gate['max_distance_m']:.0f} cm"),
        ("normals agree", text_of(is_aligned)),
        ("used", text_of(inlier)),
    ]
    steps.append(
        Step(gate, f"The gates, distance and angle of the normals: {verdict}.", gates, whole)
    )
    if inlier:
        index = int(gate["inlier"].flatten()[: at[0] * gate["inlier"].shape[1] + at[1]].sum())
        r = r_line["r"][index]
        J = J_line["J"][index]
        title = "Only the distance to the plane of q counts."
        steps.append(Step(r_line, title, [("r = (p − q) . n", f"{1000 * float(r):.2f} mm")], whole))
        rows = [("n", text_of(J[:3], 3)), ("p x n", text_of(J[3:], 3))]
        steps.append(
            Step(J_line, "How r changes with a small motion: this pixel's row of J.", rows, whole)
        )
    return steps


def _sums(recording: Recording) -> list[Step]:
    system = recording.at("return IcpSystem(")[0]
    solve = recording.at("y = -directions")[0]
    H = system["return"].H
    b = system["return"].b
    step = recording.at("step = _step(")[0]["step"]
    poses = recording.at("T_WC = se3.translate(next_pose(")[0]
    scene = {
        **_residuals(recording, 0),
        "pixel": None,
        "p": None,
        "q": None,
        "n": None,
        "H": H.numpy(),
    }
    names = ("x", "y", "z", "about x", "about y", "about z")
    rows = [(name, text_of(x)) for name, x in zip(names, b, strict=True)]
    title = (
        f"H = sum w J^T J and b = sum w J^T r over the {system['return'].n_inliers} pairs: six "
        "equations."
    )
    steps = [Step(system, title, rows, scene, ("", "b"))]
    determined = [text_of(bool(k)) for k in solve["is_determined"]]
    rows = [
        (str(k), text_of(e), s)
        for k, (e, s) in enumerate(zip(solve["eigenvalues"], determined, strict=True), 1)
    ]
    title = "Solved along the principal directions, and only along those that the scene determines."
    steps.append(Step(solve, title, rows, scene, ("direction", "information", "determined")))
    xi = [
        (name, f"{1000 * float(x):.2f} mm" if k < 3 else f"{float(x.rad2deg()):.3f}°")
        for k, (name, x) in enumerate(zip(names, step.xi, strict=True))
    ]
    next_scene = scene | _residuals(recording, 1)
    steps.append(
        Step(
            poses,
            "The pose is moved by exp(xi); all residuals change.",
            xi,
            next_scene,
            ("motion", "xi"),
        )
    )
    last = recording.at("return IcpResult(")[0]
    system0 = recording.at("system, joint_system = rows.at(level,")[0]["system"]
    system1 = last["system"]
    rows = [
        ("rms before", f"{1000 * system0.rms_m:.2f} mm, {system0.n_inliers} pairs"),
        ("rms after", f"{1000 * system1.rms_m:.2f} mm, {system1.n_inliers} pairs"),
        ("the surface moved by", f"{1000 * step.length_m:.2f} mm"),
    ]
    title = "One iteration is done. The next one looks for partners again, from the new pose."
    steps.append(Step(last, title, rows, next_scene))
    return steps


def _icp_picture(figure: "Figure", scene: dict[str, Any]) -> None:
    image_axes = figure.add_axes((0.01, 0.30, 0.57, 0.60))
    style(image_axes, title=f"residual, to {100 * scene['gate_m']:g} cm (red −, blue +)")
    image_axes.imshow(
        _colours(residual_level(scene["residual_m"], scene["gate_m"])),
        interpolation="nearest",
        aspect="auto",
    )
    if scene["pixel"]:
        image_axes.plot(
            *scene["pixel"][::-1],
            "s",
            color=PALETTE[1],
            markersize=9,
            fillstyle="none",
            mew=2,
        )
    image_axes.set(xticks=[], yticks=[])
    if scene["q"] is not None:
        _draw_pair(figure, scene["p"], scene["q"], scene["n"])
    if scene["H"] is not None:
        _draw_matrix(figure, scene["H"])


def _draw_pair(figure: "Figure", p_W: np.ndarray, q_W: np.ndarray, n_W: np.ndarray) -> None:
    """A point, its partner, and the plane of the partner, seen along the plane."""
    sketch = figure.add_axes((0.63, 0.52, 0.35, 0.40))
    style(sketch, title="p, q and the plane of q")
    sketch.set(xlim=(-1, 1), ylim=(-1, 1), xticks=[], yticks=[])
    p, q, n = _flat(p_W, q_W, n_W)
    foot = p - n * float((p - q) @ n)
    sketch.plot(
        [-0.95, 0.95],
        [q[1], q[1]],
        color=PALETTE[0],
        linewidth=2,
    )
    sketch.plot(
        [q[0], q[0]],
        [q[1], q[1] + 0.6],
        color=PALETTE[2],
        linewidth=1.6,
    )
    sketch.plot(
        [p[0], foot[0]],
        [p[1], foot[1]],
        "--",
        color=PALETTE[3],
        linewidth=1.6,
    )
    sketch.plot(
        [p[0], q[0]],
        [p[1], q[1]],
        "o",
        color=PALETTE[1],
        markersize=7,
    )
    for name, at in zip(
        "pqn",
        (p, q, q + 0.6 * n),
        strict=True,
    ):
        sketch.text(
            at[0] + 0.08,
            at[1] + 0.03,
            name,
            color=BETWEEN,
            fontsize=9,
        )


def _draw_matrix(figure: "Figure", H: np.ndarray) -> None:
    """H, scaled so that its diagonal is 1."""
    matrix = figure.add_axes((0.66, 0.03, 0.32, 0.36))
    style(matrix, title="H (blue +, red −)")
    matrix.imshow(
        _colours(H / np.sqrt(np.outer(H.diagonal(), H.diagonal()))),
        interpolation="nearest",
    )
    matrix.set(xticks=[], yticks=[])


def _colours(values: np.ndarray) -> np.ndarray:
    """Blue for positive and red for negative numbers in -1..1, nothing for NaN."""
    has_value = ~np.isnan(values)
    rgb = distance_colours(np.where(has_value, np.clip(values, -1, 1), 0)) / 255.0
    return np.concatenate([rgb, has_value[..., None].astype(float)], axis=2)


def _flat(
    p: np.ndarray,
    q: np.ndarray,
    n: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """p and q in the plane of p - q and n, with n upwards and the longer of both distances 1.2
    wide."""
    normal_part = float((p - q) @ n)
    tangent_part = float(np.linalg.norm((p - q) - normal_part * n))
    size = max(abs(normal_part), tangent_part, 1e-6) / 0.8
    low = -0.4 if normal_part > 0 else 0.2
    return (
        np.array([tangent_part / size - 0.4, low + normal_part / size]),
        np.array([-0.4, low]),
        np.array([0.0, 1.0]),
    )
