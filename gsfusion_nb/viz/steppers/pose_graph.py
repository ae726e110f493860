"""A stepper through one Gauss-Newton step on a pose graph."""

from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ...drawing.curves import BETWEEN, PALETTE, style
from ...errors import ArgumentError
from ...tracking.edges import Edge
from ...tracking.pose_graph import optimise_poses
from .recording import Line, Recording, record
from .stepper import Step, Stepper, text_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure


GRAPH_WATCH = {
    optimise_poses: {
        "relative_pose_error": ("e", "J"),
        "weighted": (),
        "_descend": ("T_WC", "e", "J_i", "J_j", "error", "error_after", "share", "T_proposed"),
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
    T_proposed = _first(recording, "T_proposed = pose_graph_step")["T_proposed"]
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
    new_error = _first(recording, "error_after = graph.robust_error(errors[0], robust)")
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
        ("error after", text_of(new_error["error_after"])),
    ]
    fell = new_error["error_after"] <= old_error["error"]
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
