"""A stepper through marching cubes: eight corner values, the case, its cut edges, their vertices, the triangles."""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from jaxtyping import Int
from torch import Tensor

from ...drawing.curves import BETWEEN, PALETTE
from ...tsdf import TsdfVolume, extract_mesh
from ...tsdf.triangle_table import EDGES
from ...tsdf.trilinear import CORNERS
from .recording import Recording, record
from .stepper import Step, Stepper, moving, step_of, text_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Voxel = tuple[int, int, int]
WATCH = {
    extract_mesh: {
        "extract_mesh": ("triangles", "edges", "faces", "vertices_W"),
        "_triangles": ("corner", "D", "weight", "usable", "case", "count", "cube", "nth", "axis", "lower"),
        "_vertices": ("D0", "D1", "t", "xyz_W"),
    }
}


def row_of_cells(volume: TsdfVolume, cells: int = 1) -> Voxel:
    """The lowest corner of ``cells`` cells beside each other along x with many triangles each, but no more than four.

    A smooth surface cuts a cell in up to four triangles; more are at edges and in noise.

    Raises:
        ValueError: the surface of the volume has no such row.
    """
    mesh = extract_mesh(volume)
    middle = mesh.vertices_W.double()[mesh.faces].mean(1) / volume.config.voxel_size_m - 0.5
    place, count = middle.floor().long().unique(dim=0, return_counts=True)
    triangles = {tuple(xyz): int(n) for xyz, n in zip(place.tolist(), count.tolist(), strict=True)}

    def of_row(start: Voxel) -> list[int]:
        return [triangles.get((start[0] + k, start[1], start[2]), 0) for k in range(cells)]

    rows = [start for start in triangles if min(of_row(start)) > 0 and max(of_row(start)) <= 4]
    best = max(rows, key=lambda start: (min(of_row(start)), sum(of_row(start))), default=None)
    if best is None:
        raise ValueError(f"no {cells} cells in a row have triangles")
    return best


def cut_out(volume: TsdfVolume, start: Voxel, cells: int) -> TsdfVolume:
    """A volume in which only the corners of ``cells`` cells along x from ``start`` were observed, as in ``volume``.

    Raises:
        ValueError: a corner is not allocated.
    """
    grid = torch.cartesian_prod(torch.arange(cells + 1), torch.arange(2), torch.arange(2))
    ijk = (torch.tensor(start) + grid).to(volume.device)
    there = volume.find_voxels(ijk)
    if bool((there < 0).any()):
        raise ValueError(f"a corner of the {cells} cells from voxel {start} on is not allocated")
    small = TsdfVolume(volume.config, volume.device)
    small.add_blocks((ijk >> 3).unique(dim=0))
    here = small.find_voxels(ijk)
    small.D.view(-1)[here] = volume.D.view(-1)[there]
    small.W.view(-1)[here] = volume.W.view(-1)[there]
    small.rgb_planes[here // 512, :, here % 512] = volume.voxel_rgb(there)
    return small


def record_cells(volume: TsdfVolume, start: Voxel, cells: int) -> tuple[Recording, list[int]]:
    """``extract_mesh`` of some cells only: a recording, and the row of each of them among all cells."""
    small = cut_out(volume, start, cells)
    recording = record(lambda: extract_mesh(small), WATCH)
    corner = recording.at("D, weight = volume.D")[0]["corner"]
    first = small.find_voxels(torch.tensor([[start[0] + k, *start[1:]] for k in range(cells)]).to(small.device))
    return recording, [int((corner[:, 0] == at).nonzero()[0]) for at in first]


def marching_cubes_stepper(volume: TsdfVolume, start: Voxel | None = None, *, cells: int = 1) -> Stepper:
    """Press Next through ``extract_mesh`` on one cell, or on a row of cells along x.

    Corners inside the surface (D < 0) are red, the others blue; vertices are orange.

    Args:
        volume: The map.
        start: The voxel of the lowest corner of the first cell; by default that of ``row_of_cells``.
        cells: Number of cells.

    Raises:
        ValueError: the cells are not in the volume, or none has triangles.
    """
    start = start or row_of_cells(volume, cells)
    recording, rows = record_cells(volume, start, cells)
    steps: list[Step] = []
    scene: dict[str, Any] = {"D": {}, "cut": (), "points": np.zeros((0, 3)), "faces": (), "cell": 0}
    for k, row in enumerate(rows):
        steps += _of_cell(recording, row, k, steps[-1].scene | {"cell": k} if steps else scene, cells)
    steps += _of_vertices(recording, start, volume.config.voxel_size_m, steps[-1].scene)
    name = "one cell" if cells == 1 else f"a row of {cells} cells"
    label = f"Marching cubes on {name}"
    build = lambda figure: _picture(figure, cells)  # noqa: E731
    stills = (0, min(4, len(steps) - 1), len(steps) - 1)
    return Stepper(steps, build, name=f"marching-cubes-{cells}", label=label, size=(450, 330), stills=stills)


def _of_cell(recording: Recording, row: int, k: int, scene: dict[str, Any], cells: int) -> list[Step]:
    values, usable = recording.at("D, weight = volume.D")[0], recording.at("usable = ((corner")[0]
    cased, listed = recording.at("case = ((D <")[0], recording.at("cube, nth = ")[0]
    edged = recording.at("axis, lower = ")[0]
    D, case = values["D"][row], int(cased["case"][row])
    mine = (listed["cube"] == row).nonzero().squeeze(1)
    edges = [list(zip(edged["axis"][i].tolist(), edged["lower"][i].tolist(), strict=True)) for i in mine]
    scene = scene | {"D": scene["D"] | {k: D.numpy()}}
    which = f"Cell {k + 1} of {cells}: t" if cells > 1 else "T"
    corners = [(f"{c} at {text_of(tuple(CORNERS[c].tolist()))}", f"{float(D[c]):+.3f}".replace("-", "−"),
                "inside" if D[c] < 0 else "") for c in range(8)]  # fmt: skip
    steps = [step_of(values, f"{which}he D of the eight corners; negative is behind the surface.", corners, scene,
                   ("corner", "D", ""))]  # fmt: skip
    if cells == 1:
        seen = [("smallest W", text_of(usable["weight"][row].min())), ("usable", text_of(bool(usable["usable"][row])))]
        steps.append(
            step_of(usable, "All eight corners must have been observed, or there is no triangle.", seen, scene)
        )
    bits = " + ".join(str(2**c) for c in range(8) if D[c] < 0) or "0"
    title = f"The case: one bit for each corner inside. {bits} = {case}."
    steps.append(step_of(cased, title, [("case", f"{case} = {case:08b} in binary")], scene))
    title = f"The table has {len(mine)} triangle{'s' if len(mine) != 1 else ''} for case {case}."
    steps.append(step_of(listed, title, [("triangles", str(len(mine)))], scene))
    cut = scene["cut"] + tuple((k, axis, lower) for triangle in edges for axis, lower in triangle)
    text = [(str(i + 1), ", ".join(str(EDGES.index(e)) for e in triangle)) for i, triangle in enumerate(edges)]
    title = "Each triangle is three cut edges; an edge is an axis and its lower corner. One end is inside, one outside."
    steps.append(step_of(edged, title, text, scene | {"cut": cut}, ("triangle", "edges")))
    return steps


def _of_vertices(recording: Recording, start: Voxel, voxel_m: float, scene: dict[str, Any]) -> list[Step]:
    joined, crossing = recording.at("edges, faces = triangles.unique")[0], recording.at("t = (D0 / (D0 - D1))")[0]
    placed = recording.at("xyz_W = zero_crossing(")[0]
    faces, n = joined["faces"], len(joined["edges"])
    ends = 3 * len(faces)
    numbers = [("triangles", str(len(faces))), ("their corners", str(ends)), ("different edges", str(n))]
    title = f"An edge that several triangles cut has one vertex: {ends} corners of triangles, {n} vertices."
    steps = [step_of(joined, title, numbers, scene)]
    points = (placed["xyz_W"].cpu().numpy() / voxel_m - 0.5) - np.array(start)
    for v in range(n):
        D0, D1, t = (float(crossing[name].flatten()[v]) for name in ("D0", "D1", "t"))
        scene = scene | {"points": points[: v + 1]}
        numbers = [
            ("D at the lower end", text_of(D0)), ("D at the upper end", text_of(D1)), ("t", text_of(t)),
            ("vertex", text_of(placed["xyz_W"][v]) + " m"),
        ]  # fmt: skip
        title = f"Vertex {v + 1} of {n}: where D, linear along the edge, is zero: t = {t:.3f} of the way."
        steps.append(step_of(crossing, title, numbers, scene))
    done = recording.at("return Mesh(")[0]
    scene = scene | {"faces": tuple(tuple(face) for face in faces.tolist())}
    numbers = [("vertices", str(n)), ("triangles", str(len(faces)))]
    title = "The triangles between the vertices: the surface in these cells."
    steps.append(step_of(done, title, numbers, scene))
    return steps


def _flat(xyz: np.ndarray | Int[Tensor, "N 3"]) -> np.ndarray:
    """Oblique projection: x to the right, z up, y away from the reader. [N, 2]"""
    x, y, z = np.asarray(xyz, float).T
    return np.stack([x + 0.42 * y, z + 0.34 * y], axis=1)


def _picture(figure: "Figure", cells: int) -> Callable[[Step], None]:
    from matplotlib.collections import LineCollection, PolyCollection

    axes = figure.add_axes((0.01, 0.01, 0.98, 0.98))
    axes.set_axis_off()
    axes.set_aspect("equal")
    axes.set_xlim(-0.25, cells + 0.7)
    axes.set_ylim(-0.2, 1.5)
    base = CORNERS.numpy()
    corners = [base + np.array((k, 0, 0)) for k in range(cells)]
    lines = [_flat(np.stack([c[lower], c[lower + 2**axis]])) for c in corners for axis, lower in EDGES]
    axes.add_collection(LineCollection(lines, colors=BETWEEN, linewidths=0.8, alpha=0.7))
    focus = LineCollection([], colors=BETWEEN, linewidths=1.8, animated=True)
    cut = LineCollection([], colors=PALETTE[1], linewidths=2.4, animated=True)
    faces = PolyCollection([], facecolors=PALETTE[2], edgecolors=PALETTE[2], alpha=0.55, linewidths=1, animated=True)
    for collection in (focus, faces, cut):
        axes.add_collection(collection)
    outside = moving(axes, "o", color=PALETTE[0], markersize=8)
    inside = moving(axes, "o", color=PALETTE[3], markersize=8)
    vertices = moving(axes, "D", color=PALETTE[1], markersize=5)
    values = [axes.text(0, 0, "", color=BETWEEN, fontsize=8, animated=True) for _ in range(8)]

    def update(step: Step) -> None:
        scene, k = step.scene, step.scene["cell"]
        known = [(_flat(corners[c])[i], D[i]) for c, D in scene["D"].items() for i in range(8)]
        for dots, negative in ((outside, False), (inside, True)):
            at = [p for p, D in known if (D < 0) == negative]
            dots.set_data([p[0] for p in at], [p[1] for p in at])
        focus.set_segments(lines[12 * k : 12 * k + 12] if cells > 1 else [])
        cut.set_segments([_flat(np.stack([corners[c][a], corners[c][a + 2**x]])) for c, x, a in scene["cut"]])
        for i, text in enumerate(values):
            x, y = _flat(corners[k])[i]
            text.set_position((x + 0.05, y + 0.05))
            text.set_text(f"{i}: {scene['D'][k][i]:+.3f}" if cells == 1 else "")
        points = _flat(scene["points"]) if len(scene["points"]) else np.zeros((0, 2))
        vertices.set_data(points[:, 0], points[:, 1])
        faces.set_verts([points[list(face)] for face in scene["faces"]])

    return update
