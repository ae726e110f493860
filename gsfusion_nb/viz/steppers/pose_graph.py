"""A stepper through one Gauss-Newton step on a pose graph: errors of the edges, blocks of H, solve, update."""

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ...drawing.curves import BETWEEN, PALETTE
from ...tracking.gauss_newton_poses import optimise_poses_plain
from ...tracking.pose_graph import Edge
from .recording import Line, Recording, record
from .stepper import Step, Stepper, moving, style, text_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure

WATCH = {
    optimise_poses_plain: {
        "relative_pose_error": ("e", "J"),
        "weighted": (),
        "_descend": ("T_WC", "e", "J_i", "J_j", "error", "after", "share", "proposed"),
        "pose_graph_step": ("H", "b", "xi", "T_WC"),
    }
}
_DEGREES = 180 / torch.pi


def record_pose_graph(T_WC: Float[Tensor, "K 4 4"], edges: list[Edge]) -> Recording:
    """``optimise_poses_plain`` with one step from each of its starts: a recording."""
    return record(lambda: optimise_poses_plain(T_WC, edges, iterations=1), WATCH)


def pose_graph_stepper(T_WC: Float[Tensor, "K 4 4"], edges: list[Edge]) -> Stepper:
    """Press Next through the first step of ``optimise_poses_plain`` on a small graph.

    Left: the cameras from above, the first one fixed; loops are orange, the edge in question is red. Right: the size of
    the blocks of H, one row for each pose.

    Args:
        T_WC: Camera-to-world poses to start from, four to eight of them. [K, 4, 4]
        edges: Relative poses; every pose must be connected with the first one.

    Raises:
        ValueError: there are fewer than two poses, or no edges.
    """
    if len(T_WC) < 2 or not edges:
        raise ValueError(f"two poses and an edge are needed, got {len(T_WC)} poses and {len(edges)} edges")
    recording = record_pose_graph(T_WC, edges)
    steps = [*_errors(recording, edges), *_system(recording, edges), *_update(recording)]
    proposed = _first(recording, "proposed = pose_graph_step")["proposed"]
    every = torch.cat([T_WC.double(), proposed])[:, :2, 3]
    build = lambda figure: _picture(figure, edges, every)  # noqa: E731
    stills = (len(edges) - 1, len(steps) - 4, len(steps) - 1)
    label = f"One step on a pose graph of {len(T_WC)} poses"
    return Stepper(steps, build, name="pose-graph", label=label, size=(450, 300), stills=stills)


def _first(recording: Recording, part: str) -> Line:
    return recording.at(part)[0]


def _start(recording: Recording) -> dict[str, Any]:
    T_WC = _first(recording, "error = graph.robust_error(e, robust)")["T_WC"]
    return {"T_WC": T_WC, "edge": None, "H": None}


def _errors(recording: Recording, edges: list[Edge]) -> list[Step]:
    found = _first(recording, "e, J_i, J_j = graph.errors(T_WC)")
    at = next(k for k, line in enumerate(recording) if line is found)
    inside = [line for line in recording[:at] if line.function == "relative_pose_error"]
    error = [line for line in inside if line.text.startswith("e = se3.log")][-1]
    slope = [line for line in inside if line.text.startswith("J = torch.eye")][-1]
    weights = _first(recording, "return torch.where(self.is_loop & robust, cauchy, huber)[:, None")
    steps = []
    for k, edge in enumerate(edges):
        e = error["e"][k]
        length = float((e[[3, 4, 5, 0, 1, 2]] @ edge.information.double() @ e[[3, 4, 5, 0, 1, 2]]).sqrt())
        title = f"Edge {k + 1}, {edge.kind} from pose {edge.i} to {edge.j}: how far the poses are from it."
        numbers = [
            ("translation of e", text_of(100 * e[:3], 3) + " cm"),
            ("rotation of e", text_of(_DEGREES * e[3:], 3) + "°"),
            ("length", f"{length:.2f} standard deviations"),
        ]  # fmt: skip
        steps.append(Step(line=error, title=title, numbers=numbers, scene=_start(recording) | {"edge": k}))
    norms = [(str(k + 1), text_of(float((J - torch.eye(6)).norm()))) for k, J in enumerate(slope["J"])]
    title = "The derivative of each e with respect to pose j. For small errors it is nearly the identity I."
    steps.append(Step(line=slope, title=title, heads=("edge", "|J − I|"), numbers=norms, scene=_start(recording)))
    shares = [
        (str(k + 1), edge.kind, f"{float((w * edge_i).sum() / (edge_i * edge_i).sum()):.3f}")
        for k, (edge, w, edge_i) in enumerate(zip(edges, weights["return"], _informations(edges), strict=True))
    ]
    title = "Robust weights: an edge that is many standard deviations off counts less."
    heads = ("edge", "kind", "weight")
    steps.append(Step(line=weights, title=title, heads=heads, numbers=shares, scene=_start(recording)))
    return steps


def _informations(edges: list[Edge]) -> list[Tensor]:
    order = torch.tensor([3, 4, 5, 0, 1, 2])
    return [edge.information.double()[order][:, order] for edge in edges]


def _system(recording: Recording, edges: list[Edge]) -> list[Step]:
    blocks = [line for line in recording.at("H.index_put_(") if line.call == 0]
    sides = [line for line in recording.at("b.index_add_(") if line.call == 0]
    scene = _start(recording)
    steps = []
    for k, (line, ends) in enumerate(zip(blocks, ("i, i", "i, j", "j, i", "j, j"), strict=True)):
        if k % 2 == 0:
            side = sides[k // 2]
            rows = [(str(p), text_of(b, 3)) for p, b in enumerate(side["b"])]
            title = f"b gets J^T Omega e of pose {'ij'[k // 2]} of every edge: the slope of the error at each pose."
            steps.append(Step(line=side, title=title, heads=("pose", "b"), numbers=rows, scene=dict(scene)))
        norm = line["H"].flatten(2).norm(dim=2)
        scene = scene | {"H": norm}
        title = f"H gets a block J^T Omega J at ({ends}) for each of the {len(edges)} edges."
        filled = [("blocks that are not zero", f"{int((norm > 0).sum())} of {norm.numel()}")]
        steps.append(Step(line=line, title=title, numbers=filled, scene=scene))
    return steps


def _update(recording: Recording) -> list[Step]:
    solve, move = _first(recording, "xi = torch.linalg.solve"), _first(recording, "return torch.cat([T_WC[:1]")
    before = _first(recording, "error = graph.robust_error(e, robust)")
    after = _first(recording, "after = graph.robust_error(there[0], robust)")
    H = [line for line in recording.at("H.index_put_(") if line.call == 0][-1]["H"].flatten(2).norm(dim=2)
    scene = _start(recording) | {"H": H}
    rows = [(str(k), text_of(100 * xi[:3], 3), text_of(_DEGREES * xi[3:], 3)) for k, xi in enumerate(solve["xi"], 1)]
    title = "Solve H xi = −b for all poses but the first, which is fixed: where each pose should move."
    steps = [Step(line=solve, title=title, heads=("pose", "cm", "degrees"), numbers=rows, scene=scene)]
    T = move["return"]
    rows = [(str(k), text_of(t, 4)) for k, t in enumerate(T[:, :3, 3])]
    title = "Each pose moves in its own camera frame: T exp(xi)."
    moved = scene | {"T_WC": T}
    steps.append(Step(line=move, title=title, heads=("pose", "position, m"), numbers=rows, scene=moved))
    numbers = [("error before", text_of(before["error"])), ("error after", text_of(after["after"]))]
    fell = after["after"] <= before["error"]
    title = "The robust error has fallen: the step is taken." if fell else "The error has grown: the step is halved."
    steps.append(Step(line=after, title=title, numbers=numbers, scene=moved))
    return steps


def _picture(figure: "Figure", edges: Sequence[Edge], every: Tensor) -> Callable[[Step], None]:
    from matplotlib.collections import LineCollection

    left, right = figure.add_axes((0.13, 0.15, 0.47, 0.75)), figure.add_axes((0.66, 0.30, 0.32, 0.48))
    style(left, x="x, m", y="y, m", title="cameras from above")
    style(right, title="blocks of H")
    low, high = every.amin(0), every.amax(0)
    middle, half = (low + high) / 2, 0.7 * float((high - low).max().clamp_min(0.1))
    left.set_xlim(float(middle[0]) - half, float(middle[0]) + half)
    left.set_ylim(float(middle[1]) - half, float(middle[1]) + half)
    K = max(max(e.i, e.j) for e in edges) + 1
    inks = [PALETTE[1] if e.kind == "loop" else PALETTE[0] for e in edges]
    links = LineCollection([], colors=inks, linewidths=1.6, animated=True)
    left.add_collection(links)
    start = moving(left, "o", color=BETWEEN, markersize=4, alpha=0.6)
    dots = moving(left, "o", color=PALETTE[2], markersize=7)
    focus = moving(left, "-", color=PALETTE[3], linewidth=3.5)
    names = [left.text(0, 0, str(k), color=BETWEEN, fontsize=8, animated=True) for k in range(K)]
    looks = LineCollection([], colors=PALETTE[2], linewidths=1.2, animated=True)
    left.add_collection(looks)
    image = right.imshow(np.zeros((K, K)), cmap="Blues", vmin=0, vmax=1, animated=True)
    right.set_xticks(range(K))
    right.set_yticks(range(K))
    first: list[Any] = []

    def update(step: Step) -> None:
        T = step.scene["T_WC"]
        at = T[:, :2, 3].numpy()
        first[:] = first or [at]
        start.set_data(first[0][:, 0], first[0][:, 1])
        dots.set_data(at[:, 0], at[:, 1])
        links.set_segments([at[[e.i, e.j]] for e in edges])
        ends = at + 0.25 * half * T[:, :2, 2].numpy()
        looks.set_segments([np.stack([a, b]) for a, b in zip(at, ends, strict=True)])
        for k, name in enumerate(names):
            name.set_position((at[k, 0] + 0.04 * half, at[k, 1] + 0.04 * half))
        edge = step.scene["edge"]
        focus.set_data(*(at[[edges[edge].i, edges[edge].j]].T if edge is not None else ([], [])))
        H = step.scene["H"]
        image.set_data(np.zeros((K, K)) if H is None else (H / H.max().clamp_min(1e-12)).sqrt().numpy())

    return update
