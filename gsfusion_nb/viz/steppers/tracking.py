"""Steppers through tracking: one iteration of ICP, and one Gauss-Newton step on a pose graph."""

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
from ...tracking.icp import solve_step
from ...tracking.pose_graph import Edge, optimise_poses
from ...types import Camera
from ..panels.icp import RESIDUAL_M
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
            "near",
            "aligned",
            "inlier",
            "max_distance_m",
        ),
        "point_to_plane": ("r", "J"),
        "icp_system": ("r", "J", "w", "rows"),
    },
    align: {"align": ("T_WC", "system", "step")},
    solve_step: {"solve_step": ("H", "b", "eigenvalues", "known", "y")},
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
    of q. Below: H.

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
    gate = recording.at("inlier = overlap & near & aligned")[0]
    if not bool(gate["inlier"].any()):
        raise ArgumentError("no pixel of the frame passes the gates at this pose")
    steps = [step for at in _some_pixels(gate, pixels) for step in _of_pixel(recording, at)]
    steps += _sums(recording)
    shape = tuple(gate["inlier"].shape)
    label = f"One iteration of ICP, {shape[1]} x {shape[0]} pixels"
    return Stepper(steps, _icp_picture, name="icp", label=label, size=(450, 350))


def _some_pixels(gate: Line, count: int) -> list[tuple[int, int]]:
    """Evenly spaced inliers, and a pixel that meets the surface but is refused."""
    inliers = gate["inlier"].nonzero()
    outliers = (gate["overlap"] & ~gate["inlier"]).nonzero()
    n = count - bool(len(outliers))
    pixels = [inliers[int((k + 0.5) * len(inliers) / n)] for k in range(n)]
    pixels += [outliers[len(outliers) // 2]] if len(outliers) else []
    return [(int(row), int(column)) for row, column in pixels]


def _residuals(recording: Recording, nth: int) -> np.ndarray:
    """Point-to-plane distances of the pixels that pass the gates in the n-th system; NaN
    elsewhere."""
    inlier = recording.at("inlier = overlap & near & aligned")[nth]["inlier"]
    image = torch.full(inlier.shape, torch.nan)
    image[inlier] = recording.at("r = ((xyz - surface_xyz)")[nth]["r"].float()
    return image.numpy()


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
        "residual": _residuals(recording, 0),
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
    is_near, is_aligned, inlier = (bool(gate[key][at]) for key in ("near", "aligned", "inlier"))
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
        "residual": _residuals(recording, 0),
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
    determined = [text_of(bool(k)) for k in solve["known"]]
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
    next_scene = scene | {"residual": _residuals(recording, 1)}
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
    system0 = recording.at("system, joined = rows.at(level,")[0]["system"]
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
    sketch = figure.add_axes((0.63, 0.52, 0.35, 0.40))
    matrix = figure.add_axes((0.66, 0.03, 0.32, 0.36))
    style(image_axes, title=f"residual, ±{1000 * RESIDUAL_M:.0f} mm (red −, blue +)")
    style(sketch, title="p, q and the plane of q")
    style(matrix, title="H (blue +, red −)")
    image_axes.imshow(
        _colours(scene["residual"] / RESIDUAL_M), interpolation="nearest", aspect="auto"
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
    sketch.set(xlim=(-1, 1), ylim=(-1, 1))
    if scene["q"] is not None:
        p, q, n = _flat(scene["p"], scene["q"], scene["n"])
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
    H = scene["H"]
    if H is not None:
        matrix.imshow(
            _colours(H / np.sqrt(np.outer(H.diagonal(), H.diagonal()))),
            interpolation="nearest",
        )
    for axes in (image_axes, sketch, matrix):
        axes.set(xticks=[], yticks=[])


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


GRAPH_WATCH = {
    optimise_poses: {
        "relative_pose_error": ("e", "J"),
        "weighted": (),
        "_descend": ("T_WC", "e", "J_i", "J_j", "error", "after", "share", "proposed"),
        "pose_graph_step": ("H", "b", "xi", "T_WC"),
    }
}
_DEGREES = 180 / torch.pi


def pose_graph_stepper(T_WC: Float[Tensor, "K 4 4"], edges: list[Edge]) -> Stepper:
    """Press Next through the first step of ``optimise_poses`` on a small graph.

    Left: the cameras from above, the first one fixed; loops are orange, the edge in question is
    red. Right: the size of the blocks of H, one row for each pose.

    Args:
        T_WC: Camera-to-world poses to start from, four to eight of them. [K, 4, 4]
        edges: Relative poses; every pose must be connected with the first one.

    Raises:
        ValueError: there are fewer than two poses, or no edges.
    """
    if len(T_WC) < 2 or not edges:
        raise ArgumentError(
            f"two poses and an edge are needed, got {len(T_WC)} poses and {len(edges)} edges"
        )
    recording = record(lambda: optimise_poses(T_WC, edges, iterations=1), GRAPH_WATCH)
    steps = [*_errors(recording, edges), *_system(recording, edges), *_update(recording)]
    T_proposed = _first(recording, "proposed = pose_graph_step")["proposed"]
    every = torch.cat([T_WC.double(), T_proposed])[:, :2, 3]
    draw = lambda figure, scene: _graph_picture(figure, scene, T_WC, edges, every)  # noqa: E731
    label = f"One step on a pose graph of {len(T_WC)} poses"
    return Stepper(steps, draw, name="pose-graph", label=label, size=(450, 300))


def _first(recording: Recording, part: str) -> Line:
    return recording.at(part)[0]


def _start(recording: Recording) -> dict[str, Any]:
    T_WC = _first(recording, "error = graph.robust_error(e, robust)")["T_WC"]
    return {"T_WC": T_WC, "edge": None, "H": None}


def _errors(recording: Recording, edges: list[Edge]) -> list[Step]:
    end_line = _first(recording, "e, J_i, J_j = graph.errors(T_WC)")
    at = next(k for k, line in enumerate(recording) if line is end_line)
    error_lines = [line for line in recording[:at] if line.function == "relative_pose_error"]
    error = [line for line in error_lines if line.text.startswith("e = se3.log")][-1]
    slope = [line for line in error_lines if line.text.startswith("J = torch.eye")][-1]
    weights = _first(recording, "return weight[:, None, None] * self.information")
    steps = []
    for k, edge in enumerate(edges):
        e = error["e"][k]
        length = float(
            (e[[3, 4, 5, 0, 1, 2]] @ edge.information.double() @ e[[3, 4, 5, 0, 1, 2]]).sqrt()
        )
        title = (
            f"Edge {k + 1}, {edge.kind} from pose {edge.i} to {edge.j}: how far the poses are "
            "from it."
        )
        numbers = [
            ("translation of e", text_of(100 * e[:3], 3) + " cm"),
            ("rotation of e", text_of(_DEGREES * e[3:], 3) + "°"),
            ("length", f"{length:.2f} standard deviations"),
        ]
        steps.append(Step(error, title, numbers, _start(recording) | {"edge": k}))
    norms = [
        (str(k + 1), text_of(float((J - torch.eye(6)).norm()))) for k, J in enumerate(slope["J"])
    ]
    title = (
        "The derivative of each e with respect to pose j. For small errors it is nearly the "
        "identity I."
    )
    steps.append(Step(slope, title, norms, _start(recording), ("edge", "|J − I|")))
    shares = [
        (str(k + 1), edge.kind, f"{float((w * edge_i).sum() / (edge_i * edge_i).sum()):.3f}")
        for k, (edge, w, edge_i) in enumerate(
            zip(edges, weights["return"], _informations(edges), strict=True)
        )
    ]
    title = "Robust weights: an edge that is many standard deviations off counts less."
    heads = ("edge", "kind", "weight")
    steps.append(Step(weights, title, shares, _start(recording), heads))
    return steps


def _informations(edges: list[Edge]) -> list[Tensor]:
    order = torch.tensor([3, 4, 5, 0, 1, 2])
    return [edge.information.double()[order][:, order] for edge in edges]


def _system(recording: Recording, edges: list[Edge]) -> list[Step]:
    blocks = [line for line in recording.at("H = H + torch.sparse_coo_tensor(") if line.call == 0]
    sides = [line for line in recording.at("b.index_add_(") if line.call == 0]
    scene = _start(recording)
    steps = []
    for k, (line, ends) in enumerate(zip(blocks, ("i, i", "i, j", "j, i", "j, j"), strict=True)):
        if k % 2 == 0:
            side = sides[k // 2]
            rows = [(str(p), text_of(b, 3)) for p, b in enumerate(side["b"])]
            title = (
                f"b gets J^T Omega e of pose {'ij'[k // 2]} of every edge: the slope of the "
                "error at each pose."
            )
            steps.append(Step(side, title, rows, dict(scene), ("pose", "b")))
        norm = line["H"].to_dense().flatten(2).norm(dim=2)
        scene = scene | {"H": norm}
        title = f"H gets a block J^T Omega J at ({ends}) for each of the {len(edges)} edges."
        numbers = [("blocks that are not zero", f"{int((norm > 0).sum())} of {norm.numel()}")]
        steps.append(Step(line, title, numbers, scene))
    return steps


def _update(recording: Recording) -> list[Step]:
    solve = _first(recording, "xi = torch.from_numpy(splu(")
    move = _first(recording, "return torch.cat([T_WC[:1]")
    old_error = _first(recording, "error = graph.robust_error(e, robust)")
    new_error = _first(recording, "after = graph.robust_error(there[0], robust)")
    last = [line for line in recording.at("H = H + torch.sparse_coo_tensor(") if line.call == 0][-1]
    H = last["H"].to_dense().flatten(2).norm(dim=2)
    scene = _start(recording) | {"H": H}
    rows = [
        (str(k), text_of(100 * xi[:3], 3), text_of(_DEGREES * xi[3:], 3))
        for k, xi in enumerate(solve["xi"], 1)
    ]
    title = (
        "Solve H xi = −b for all poses but the first, which is fixed: where each pose should move."
    )
    steps = [Step(solve, title, rows, scene, ("pose", "cm", "degrees"))]
    T = move["return"]
    rows = [(str(k), text_of(t, 4)) for k, t in enumerate(T[:, :3, 3])]
    title = "Each pose moves in its own camera frame: T exp(xi)."
    next_scene = scene | {"T_WC": T}
    steps.append(Step(move, title, rows, next_scene, ("pose", "position, m")))
    numbers = [
        ("error before", text_of(old_error["error"])),
        ("error after", text_of(new_error["after"])),
    ]
    fell = new_error["after"] <= old_error["error"]
    title = (
        "The robust error has fallen: the step is taken."
        if fell
        else "The error has grown: the step is halved."
    )
    steps.append(Step(new_error, title, numbers, next_scene))
    return steps


def _graph_picture(
    figure: "Figure",
    scene: dict[str, Any],
    start: Tensor,
    edges: list[Edge],
    every: Tensor,
) -> None:
    map_axes = figure.add_axes((0.13, 0.15, 0.47, 0.75))
    right = figure.add_axes((0.66, 0.30, 0.32, 0.48))
    style(map_axes, x="x, m", y="y, m", title="cameras from above")
    style(right, title="blocks of H")
    low = every.amin(0)
    high = every.amax(0)
    x, y = ((low + high) / 2).tolist()
    half = 0.7 * float((high - low).max().clamp_min(0.1))
    map_axes.set(
        xlim=(x - half, x + half),
        ylim=(y - half, y + half),
    )
    K = len(start)
    at = scene["T_WC"][:, :2, 3].numpy()
    map_axes.plot(
        *start[:, :2, 3].numpy().T,
        "o",
        color=BETWEEN,
        markersize=4,
        alpha=0.6,
    )
    for k, edge in enumerate(edges):
        ink, wide = (
            (PALETTE[3], 3.5)
            if k == scene["edge"]
            else (PALETTE[1 if edge.kind == "loop" else 0], 1.6)
        )
        map_axes.plot(
            *at[[edge.i, edge.j]].T,
            color=ink,
            linewidth=wide,
        )
    ends = at + 0.25 * half * scene["T_WC"][:, :2, 2].numpy()
    map_axes.plot(
        *np.stack([at, ends]).transpose(2, 0, 1),
        color=PALETTE[2],
        linewidth=1.2,
    )
    map_axes.plot(*at.T, "o", color=PALETTE[2], markersize=7)
    for k in range(K):
        map_axes.text(
            at[k, 0] + 0.04 * half,
            at[k, 1] + 0.04 * half,
            str(k),
            color=BETWEEN,
            fontsize=8,
        )
    H = torch.zeros(K, K) if scene["H"] is None else scene["H"]
    right.imshow(
        (H / H.max().clamp_min(1e-12)).sqrt().numpy(),
        cmap="Blues",
        vmin=0,
        vmax=1,
    )
    right.set(xticks=range(K), yticks=range(K))
