"""A stepper through marching cubes on one cell or a row of cells."""

from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from jaxtyping import Int
from torch import Tensor

from ...drawing.curves import BETWEEN, PALETTE
from ...errors import ArgumentError
from ...tsdf import TsdfVolume, extract_mesh
from ...tsdf.marching_cubes import EDGES
from ...tsdf.volume import rgb_at
from ...tsdf.voxels import CORNERS
from .recording import Recording, record
from .stepper import Step, Stepper, text_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure


Voxel = tuple[int, int, int]


CELL_WATCH = {
    extract_mesh: {
        "extract_mesh": ("edges", "faces", "vertices_W"),
        "_numbered": ("triangles", "edges", "numbers"),
        "_triangles": (
            "corner",
            "D",
            "weight",
            "usable",
            "case",
            "count",
            "cube",
            "nth",
            "axis",
            "lower",
        ),
        "_vertices": ("D0", "D1", "t", "xyz_W"),
    }
}


CLEAR = 0.1
"""A vertex nearer to a corner of its cell, in voxels, makes triangles that look like a mistake."""


def row_of_cells(volume: TsdfVolume, cells: int = 1) -> Voxel:
    """The lowest corner of ``cells`` cells beside each other along x with many triangles each, but
    no more than four.

    A smooth surface cuts a cell in up to four triangles; more are at edges and in noise. Cells with
    a vertex near a corner are left out.

    Raises:
        ValueError: the surface of the volume has no such row.
    """
    mesh = extract_mesh(volume)
    corners = mesh.vertices_W.double()[mesh.faces] / volume.config.voxel_size_m - 0.5
    place, cell, count = (
        corners.mean(1).floor().long().unique(dim=0, return_inverse=True, return_counts=True)
    )
    # of a triangle's vertices from the cell's corners
    offset = (corners - corners.round()).abs().amax(-1).amin(-1)
    smallest = offset.new_full((len(place),), torch.inf).scatter_reduce(0, cell, offset, "amin")
    clear = [n if a > CLEAR else 5 for n, a in zip(count.tolist(), smallest.tolist(), strict=True)]
    triangles = dict(zip(map(tuple, place.tolist()), clear, strict=True))

    def of_row(start: Voxel) -> list[int]:
        return [triangles.get((start[0] + k, start[1], start[2]), 0) for k in range(cells)]

    rows = [start for start in triangles if min(of_row(start)) > 0 and max(of_row(start)) <= 4]
    best = max(
        rows,
        key=lambda start: (min(of_row(start)), sum(of_row(start))),
        default=None,
    )
    if best is None:
        raise ArgumentError(f"no {cells} cells in a row have triangles")
    return best


def cut_out(volume: TsdfVolume, start: Voxel, cells: int) -> TsdfVolume:
    """A volume in which only the corners of ``cells`` cells along x from ``start`` were observed,
    as in ``volume``.

    Raises:
        ValueError: a corner is not allocated.
    """
    grid = torch.cartesian_prod(
        torch.arange(cells + 1),
        torch.arange(2),
        torch.arange(2),
    )
    ijk = (torch.tensor(start) + grid).to(volume.device)
    source = volume.find_voxels(ijk)
    if bool((source < 0).any()):
        raise ArgumentError(f"a corner of the {cells} cells from voxel {start} on is not allocated")
    small = TsdfVolume(volume.config, volume.device)
    small.add_blocks((ijk >> 3).unique(dim=0))
    target = small.find_voxels(ijk)
    small.D.view(-1)[target] = volume.D.view(-1)[source]
    small.W.view(-1)[target] = volume.W.view(-1)[source]
    small.rgb_planes[target // 512, :, target % 512] = rgb_at(volume, source)
    return small


def marching_cubes_stepper(
    volume: TsdfVolume, start: Voxel | None = None, *, cells: int = 1
) -> Stepper:
    """Press Next through ``extract_mesh`` on one cell, or on a row of cells along x.

    Corners inside the surface (D < 0) are red, the others blue; vertices are orange.

    Args:
        volume: The map.
        start: The voxel of the lowest corner of the first cell; by default that of
            ``row_of_cells``.
        cells: Number of cells.

    Raises:
        ValueError: the cells are not in the volume, or none has triangles.
    """
    start = start or row_of_cells(volume, cells)
    small = cut_out(volume, start, cells)
    recording = record(lambda: extract_mesh(small), CELL_WATCH)
    corner = recording.at("weight = volume.W.view(-1)")[0]["corner"]
    first = small.find_voxels(
        torch.tensor([[start[0] + k, *start[1:]] for k in range(cells)]).to(small.device)
    )
    rows = [int((corner[:, 0] == at).nonzero()[0]) for at in first]
    steps: list[Step] = []
    scene: dict[str, Any] = {"D": {}, "cut": (), "points": np.zeros((0, 3)), "faces": (), "cell": 0}
    for k, row in enumerate(rows):
        steps += _of_cell(
            recording,
            row,
            k,
            steps[-1].scene | {"cell": k} if steps else scene,
            cells,
        )
    steps += _of_vertices(recording, start, volume.config.voxel_size_m, steps[-1].scene)
    name = "one cell" if cells == 1 else f"a row of {cells} cells"
    label = f"Marching cubes on {name}"
    draw = lambda figure, scene: _cell_picture(figure, scene, cells)  # noqa: E731
    return Stepper(steps, draw, name=f"marching-cubes-{cells}", label=label, size=(450, 330))


def _of_cell(
    recording: Recording, row: int, k: int, scene: dict[str, Any], cells: int
) -> list[Step]:
    values = recording.at("weight = volume.W.view(-1)")[0]
    usable = recording.at("usable = ((corner")[0]
    case_line = recording.at("case = ((D <")[0]
    list_line = recording.at("cube, nth = ")[0]
    edge_line = recording.at("axis, lower = ")[0]
    D = values["D"][row]
    case = int(case_line["case"][row])
    mine = (list_line["cube"] == row).nonzero().squeeze(1)
    edges = [
        list(
            zip(
                edge_line["axis"][i].tolist(),
                edge_line["lower"][i].tolist(),
                strict=True,
            )
        )
        for i in mine
    ]
    scene = scene | {"D": scene["D"] | {k: D.numpy()}}
    which = f"Cell {k + 1} of {cells}: t" if cells > 1 else "T"
    corners = [
        (
            f"{c} at {text_of(tuple(CORNERS[c].tolist()))}",
            f"{float(D[c]):+.3f}".replace("-", "−"),
            "inside" if D[c] < 0 else "",
        )
        for c in range(8)
    ]
    steps = [
        Step(
            values,
            f"{which}he D of the eight corners; negative is behind the surface.",
            corners,
            scene,
            ("corner", "D", ""),
        )
    ]
    if cells == 1:
        corner_weights = [
            ("smallest W", text_of(usable["weight"][row].min())),
            ("usable", text_of(bool(usable["usable"][row]))),
        ]
        steps.append(
            Step(
                usable,
                "All eight corners must have been observed, or there is no triangle.",
                corner_weights,
                scene,
            )
        )
    bits = " + ".join(str(2**c) for c in range(8) if D[c] < 0) or "0"
    title = f"The case: one bit for each corner inside. {bits} = {case}."
    steps.append(Step(case_line, title, [("case", f"{case} = {case:08b} in binary")], scene))
    title = f"The table has {len(mine)} triangle{'s' if len(mine) != 1 else ''} for case {case}."
    steps.append(
        Step(
            list_line,
            title,
            [("triangles", str(len(mine)))],
            scene,
        )
    )
    cut_edges = scene["cut"] + tuple(
        (k, axis, lower) for triangle in edges for axis, lower in triangle
    )
    text = [
        (str(i + 1), ", ".join(str(EDGES.index(e)) for e in triangle))
        for i, triangle in enumerate(edges)
    ]
    title = (
        "Each triangle is three cut edges; an edge is an axis and its lower corner. One end is "
        "inside, one outside."
    )
    steps.append(
        Step(
            edge_line,
            title,
            text,
            scene | {"cut": cut_edges},
            ("triangle", "edges"),
        )
    )
    return steps


def _of_vertices(
    recording: Recording, start: Voxel, voxel_m: float, scene: dict[str, Any]
) -> list[Step]:
    join_line = recording.at("edges, numbers = triangles.unique")[0]
    crossing = recording.at("t = (D0 / (D0 - D1))")[0]
    place_line = recording.at("xyz_W = zero_crossing(")[0]
    faces = join_line["numbers"]
    n = len(join_line["edges"])
    ends = 3 * len(faces)
    numbers = [
        ("triangles", str(len(faces))),
        ("their corners", str(ends)),
        ("different edges", str(n)),
    ]
    title = (
        f"An edge that several triangles cut has one vertex: {ends} corners of triangles, {n} "
        "vertices."
    )
    steps = [Step(join_line, title, numbers, scene)]
    points = (place_line["xyz_W"].cpu().numpy() / voxel_m - 0.5) - np.array(start)
    for v in range(n):
        D0, D1, t = (float(crossing[name].flatten()[v]) for name in ("D0", "D1", "t"))
        scene = scene | {"points": points[: v + 1]}
        numbers = [
            ("D at the lower end", text_of(D0)),
            ("D at the upper end", text_of(D1)),
            ("t", text_of(t)),
            ("vertex", text_of(place_line["xyz_W"][v]) + " m"),
        ]
        title = (
            f"Vertex {v + 1} of {n}: where D, linear along the edge, is zero: t = {t:.3f} of "
            "the way."
        )
        steps.append(Step(crossing, title, numbers, scene))
    end_line = recording.at("return Mesh(")[0]
    scene = scene | {"faces": tuple(tuple(face) for face in faces.tolist())}
    numbers = [("vertices", str(n)), ("triangles", str(len(faces)))]
    title = "The triangles between the vertices: the surface in these cells."
    steps.append(Step(end_line, title, numbers, scene))
    return steps


def _flat(xyz: np.ndarray | Int[Tensor, "N 3"]) -> np.ndarray:
    """Oblique projection: x to the right, z up, y away from the reader. [N, 2]"""
    x, y, z = np.asarray(xyz, float).T
    return np.stack([x + 0.42 * y, z + 0.34 * y], axis=1)


def _cell_picture(figure: "Figure", scene: dict[str, Any], cells: int) -> None:
    from matplotlib.collections import LineCollection, PolyCollection

    axes = figure.add_axes((0.01, 0.01, 0.98, 0.98))
    cell = scene["cell"]
    axes.set_axis_off()
    axes.set(
        aspect="equal",
        xlim=(-0.25, cells + 0.7),
        ylim=(-0.2, 1.5),
    )
    corners = [CORNERS.numpy() + np.array((k, 0, 0)) for k in range(cells)]

    def edge(k: int, axis: int, lower: int) -> np.ndarray:
        return _flat(np.stack([corners[k][lower], corners[k][lower + 2**axis]]))

    for k in range(cells):
        wide = 1.8 if k == cell and cells > 1 else 0.8
        axes.add_collection(
            LineCollection(
                [edge(k, *e) for e in EDGES],
                colors=BETWEEN,
                linewidths=wide,
                alpha=0.7,
            )
        )
    points = _flat(scene["points"]) if len(scene["points"]) else np.zeros((0, 2))
    triangles = [points[list(face)] for face in scene["faces"]]
    axes.add_collection(
        PolyCollection(triangles, facecolors=PALETTE[2], edgecolors=PALETTE[2], alpha=0.55)
    )
    axes.add_collection(
        LineCollection(
            [edge(*cut_edge) for cut_edge in scene["cut"]],
            colors=PALETTE[1],
            linewidths=2.4,
        )
    )
    for k, D in scene["D"].items():
        at = _flat(corners[k])
        axes.scatter(
            *at.T,
            s=64,
            c=[PALETTE[3] if d < 0 else PALETTE[0] for d in D],
            zorder=3,
        )
        for i in range(8 if cells == 1 else 0):
            axes.text(
                at[i, 0] + 0.05,
                at[i, 1] + 0.05,
                f"{i}: {D[i]:+.3f}",
                color=BETWEEN,
                fontsize=8,
            )
    axes.plot(*points.T, "D", color=PALETTE[1], markersize=5)
