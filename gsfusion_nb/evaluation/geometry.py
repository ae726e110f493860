"""Scores of a surface: a mesh or a map of discs against the truth, a mesh's colours, centres
against the own mesh.

No ICP alignment is applied: a map made from given poses is in the world frame of its ground truth,
and aligning it would hide a systematic shift. Distances are stored in metres and printed in
centimetres.
"""

import math
from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ..checks import check_finite, check_positive, check_shape
from ..errors import ArgumentError
from ..geometry import project, quaternion, se3
from ..large_maps.chunks import Chunks, chunks_of_points, rows_of_chunks, seen_chunks
from ..resources import MAP_MEMORY
from ..types import Frame, GaussianParams, Mesh
from .image import psnr
from .metrics import NotComputed

if TYPE_CHECKING:
    from scipy.spatial import KDTree

NEIGHBOURS = 8
"""Number of nearby points whose triangles are tested for the nearest surface point; 8 covers the
triangles around a typical vertex."""
SAMPLES_PER_M2 = 10_000
"""One point per cm^2, as GSFusion's released evaluation draws on the mesh."""
BEHIND_M = 0.05
"""How far behind the measured depth a point still counts as seen, metres."""
FACES_AT_A_TIME = 1 << 20
SAMPLES_AT_A_TIME = 1 << 20
"""Limit the memory for intermediate results."""
POINTS_AT_A_TIME = 2_000
"""Of those whose distances to triangles are found together: the intermediate results stay in the
cache."""
CELL_M = 0.1
"""Points are looked up by cells of this size, metres."""
NEAR_M = 0.02
"""A view shows a vertex if its measured depth there differs by less than this, metres."""


def sample_surface(
    mesh: Mesh, n: int, generator: torch.Generator
) -> tuple[Float[Tensor, "n 3"], Int[Tensor, " n"]]:
    """``n`` points spread evenly over the area of ``mesh``, float64, and the triangles that they
    lie on.

    A triangle is drawn with probability area / total area; inside it the point (1 - r) a + r ((1 -
    s) b + s c) with r = sqrt(u1), s = u2 is uniform.

    Raises:
        ValueError: if the mesh has no area.

    Differentiable: no.
    """
    upto = _areas(mesh).cumsum(0)
    if len(upto) == 0 or not upto[-1] > 0:
        raise ArgumentError(
            f"a mesh to sample must have area, got {len(upto)} faces of total area 0"
        )
    return _sampled(mesh, upto, n, generator)


def _sampled(
    mesh: Mesh, upto: Float[Tensor, " F"], n: int, generator: torch.Generator
) -> tuple[Float[Tensor, "n 3"], Int[Tensor, " n"]]:
    """As ``sample_surface``; ``upto``: running sums of the areas of the faces."""
    face, draw = _drawn_by_area(upto, n, generator)
    r = draw[:, 1:2].sqrt()
    s = draw[:, 2:3]
    a, b, c = _corners(mesh, face).unbind(1)
    return (1 - r) * a + r * ((1 - s) * b + s * c), face


def _drawn_by_area(
    upto: Float[Tensor, " N"], n: int, generator: torch.Generator
) -> tuple[Int[Tensor, " n"], Float[Tensor, "n 3"]]:
    """``n`` rows drawn in proportion to their areas, of which ``upto`` are the running sums, and
    the numbers in 0..1 that were drawn for each: the first chose the row, the other two are
    free."""
    draw = torch.rand(
        n,
        3,
        generator=generator,
        dtype=torch.float64,
        device=generator.device,
    ).to(upto.device)
    return torch.searchsorted(
        upto,
        draw[:, 0] * upto[-1],
        right=True,
    ).clamp(max=len(upto) - 1), draw


def mesh_scores(
    mesh: Mesh,
    reference: Mesh,
    *,
    generator: torch.Generator,
    threshold_m: float = 0.03,
    n_samples: int = 200_000,
) -> dict[str, float] | NotComputed:
    """Accuracy and completion of ``mesh`` against ``reference``, from even samples of both
    surfaces.

    Args:
        mesh: The reconstruction.
        reference: The true surface, already reduced to the part that was seen (``cull_unseen``).
        generator: Draws the samples.
        threshold_m: For precision, completion ratio and F-score, metres.
        n_samples: Points drawn on each surface.

    Returns:
        Mean distance from the reconstruction to the truth (``accuracy_m``) and back
        (``completion_m``), metres; share of either that is nearer than the threshold to the other
        (``precision``, ``completion_ratio``), their harmonic mean (``f_score``), and
        ``threshold_m``; or the reason why there are none.

    Differentiable: no. Source: accuracy and completion as in iMAP (Sucar et al. 2021), sampled as
    NICE-SLAM does.
    """
    check_positive("threshold_m", threshold_m)
    check_positive("n_samples", n_samples)
    if len(mesh.faces) == 0:
        return NotComputed("the reconstructed mesh has no faces")
    ours = sample_surface(mesh, n_samples, generator)
    truth = sample_surface(reference, n_samples, generator)
    return _scores(
        _distance(ours[0], reference, truth),
        _distance(truth[0], mesh, ours),
        threshold_m,
    )


def sample_discs(
    params: GaussianParams, n: int, generator: torch.Generator
) -> Float[Tensor, "n 3"]:
    """``n`` points spread evenly over the opaque discs, each with a radius of one standard
    deviation.

    A disc is drawn with probability a b / sum, its two largest standard deviations; inside it
    sqrt(u) makes the radius uniform over the area. Source: Peng et al. 2024, section 3.1 (the
    surfel's extent); the released evaluation takes the same number of points on every disc instead.
    """
    solid = params[params.opacity_logit > 0]
    if not len(solid):
        return params.xyz_W.new_zeros(0, 3).double()
    scale, axis = solid.log_scale.double().exp().sort(dim=1, descending=True)
    upto = (scale[:, 0] * scale[:, 1]).cumsum(0)
    row, draw = _drawn_by_area(upto, n, generator)
    r = draw[:, 1].sqrt()
    angle = 2 * torch.pi * draw[:, 2]
    R = quaternion.to_matrix(solid.quat.double())[row]
    a, b = (R.gather(2, axis[row, k, None, None].expand(-1, 3, 1)).squeeze(2) for k in (0, 1))
    along_a = scale[row, 0] * r * angle.cos()
    along_b = scale[row, 1] * r * angle.sin()
    return solid.xyz_W.double()[row] + along_a[:, None] * a + along_b[:, None] * b


def disc_scores(
    params: GaussianParams,
    reference: Mesh,
    *,
    generator: torch.Generator,
    threshold_m: float = 0.03,
    n_samples: int = 200_000,
) -> dict[str, float] | NotComputed:
    """Accuracy and completion of the opaque discs against ``reference``, named as by
    ``mesh_scores``, from samples.

    Args:
        params: The map.
        reference: The true surface, already reduced to the part that was seen (``cull_unseen``).
        generator: Draws the samples.
        threshold_m: Threshold of the shares, metres.
        n_samples: Number of points on each of the two surfaces.

    Differentiable: no.
    """
    ours = sample_discs(params, n_samples, generator)
    if not len(ours):
        return NotComputed("the map has no opaque Gaussian")
    truth, _ = sample_surface(reference, n_samples, generator)
    return _scores(_to_nearest(ours, truth), _to_nearest(truth, ours), threshold_m)


def centres_to_own_mesh(
    params: GaussianParams, mesh: Mesh, *, generator: torch.Generator
) -> tuple[float, float] | NotComputed:
    """How far the Gaussian centres are from the run's own mesh, as GSFusion's released evaluation
    measures it.

    One way only, from every centre (also of transparent Gaussians) to the nearest of the points
    drawn on the mesh, one per cm^2. It says how well the two maps of a run agree, not how accurate
    either is: a mesh in the wrong place with Gaussians on it scores well. Accuracy against a true
    surface is ``mesh_scores``. Even for centres exactly on the mesh it is about half the sample
    spacing of 1 cm.

    Args:
        params: The map.
        mesh: The mesh of the same run.
        generator: Draws the samples.

    Returns:
        Mean distance, metres ("L1 SCD" of the released evaluation), and mean squared distance,
        square metres ("L2 SCD"), or the reason why there are none.

    Differentiable: no. Source: GSFusion's released evaluation (``eval_pcd.py``).
    """
    if not len(params):
        return NotComputed("the map has no Gaussian")
    if lost := int((~params.xyz_W.isfinite().all(1)).sum()):
        return NotComputed(f"the centres of {lost} Gaussians are not finite")
    areas = _areas(mesh)
    n = int(areas.sum() * SAMPLES_PER_M2)
    upto = areas.cumsum(0)
    if n == 0:
        return NotComputed("the run's mesh is smaller than 1 cm^2")
    xyz = params.xyz_W.double()
    distance = torch.full((len(params),), math.inf, dtype=torch.float64)
    for start in range(0, n, SAMPLES_AT_A_TIME):
        samples = _sampled(mesh, upto, min(SAMPLES_AT_A_TIME, n - start), generator)[0]
        distance = torch.minimum(distance, _to_nearest(xyz, samples))
    return float(distance.mean()), float(distance.square().mean())


def mesh_psnr(mesh: Mesh, frames: Iterable[Frame]) -> float | NotComputed:
    """PSNR between the vertices of a mesh and the pixels that show them, dB, mean of the views.

    A vertex is compared with the pixel that contains its projection, if the depth there is that of
    the vertex. What the triangles show between the vertices is not compared, nor what the mesh does
    not cover.

    Args:
        mesh: The mesh; its colours are clamped to 0..1 and rounded to 8 bits, as in ``mesh.ply``.
        frames: The views, with poses in the frame of the mesh; one pass.

    Returns:
        Decibels, or the reason why there are none. Views that show no vertex do not count.

    Differentiable: no.
    """
    scores = []
    chunks = chunks_of_points(mesh.vertices_W)
    for frame in frames:
        frame = frame.to(mesh.vertices_W.device)
        rows, z_m, at = _in_view(mesh.vertices_W, chunks, frame)
        depth_m = frame.depth_m[at]
        near = (depth_m > 0) & ((depth_m - z_m).abs() < NEAR_M)
        if bool(near.any()):
            scores.append(
                psnr(
                    mesh.rgb[rows[near]][None],
                    frame.rgb[at][near][None],
                )
            )
    if not scores:
        return NotComputed("no view shows a vertex of the mesh")
    return math.fsum(scores) / len(scores)


def _in_view(
    xyz_W: Float[Tensor, "N 3"],
    chunks: Chunks,
    frame: Frame,
    but: Bool[Tensor, " N"] | None = None,
) -> tuple[Int[Tensor, " M"], Float[Tensor, " M"], tuple[Tensor, Tensor]]:
    """Points inside the image of a frame, without those in ``but``, their depths, rows and columns
    of their pixels."""
    T_CW = se3.inverse(frame.T_WC.to(xyz_W))
    camera = frame.camera
    seen = seen_chunks(chunks, camera, frame.T_WC, frame.depth_m)
    rows = rows_of_chunks(seen, len(xyz_W)).to(xyz_W.device)
    rows = rows if but is None else rows[~but[rows]]
    xyz_C = se3.apply(T_CW, xyz_W[rows])
    in_front = (xyz_C[:, 2] > 1e-6).nonzero()[:, 0]
    uv = project(camera, xyz_C[in_front])
    inside = ((uv >= 0) & (uv < torch.tensor([camera.width, camera.height], device=uv.device))).all(
        dim=1
    )
    column, row = uv[inside].long().unbind(1)
    return rows[in_front[inside]], xyz_C[in_front[inside], 2], (row, column)


def seen_by(
    xyz_W: Float[Tensor, "N 3"],
    frames: Iterable[Frame],
) -> Bool[Tensor, " N"]:
    """Points that at least one frame shows: inside its image, and at most 5 cm behind the measured
    depth.

    A pixel without measured depth shows nothing. The frames are read one by one.

    Args:
        xyz_W: Points, metres. [N, 3]
        frames: The observations; one pass.

    Differentiable: no.
    """
    seen = torch.zeros(len(xyz_W), dtype=torch.bool, device=xyz_W.device)
    chunks = chunks_of_points(xyz_W)
    for frame in frames:
        if bool(seen.all()):
            break
        rows, z_m, at = _in_view(xyz_W, chunks, frame, but=seen)
        measured = frame.depth_m.to(xyz_W)[at]
        seen[rows[(measured > 0) & (z_m <= measured + BEHIND_M)]] = True
        MAP_MEMORY.give_back()
    return seen


def cull_unseen(mesh: Mesh, frames: Iterable[Frame]) -> Mesh:
    """The part of ``mesh`` that the frames show: faces of which a corner or the centroid is
    ``seen_by`` one of them.

    For meshes of small triangles; a wall of two triangles is kept completely if one of its corners
    is seen.
    """
    n = len(mesh.vertices_W)
    points = MAP_MEMORY.rows(
        n + len(mesh.faces),
        3,
        dtype=mesh.vertices_W.dtype,
        device=mesh.vertices_W.device,
    )
    points[:n] = mesh.vertices_W
    points[n:] = _of_faces(mesh, lambda corners: corners.mean(1), 3)
    seen = seen_by(points, frames)
    faces = _picked(
        mesh.faces,
        seen[:n][mesh.faces.long()].any(1) | seen[n:],
    )
    used = torch.zeros(n, dtype=torch.bool, device=faces.device)
    used[faces.view(-1).long()] = True
    number = used.cumsum(0) - 1
    for part in faces.split(FACES_AT_A_TIME):
        part.copy_(number[part.long()])
    return Mesh(
        vertices_W=_picked(mesh.vertices_W, used),
        faces=faces,
        rgb=_picked(mesh.rgb, used),
    )


def _picked(rows: Tensor, which: Bool[Tensor, " N"]) -> Tensor:
    """A copy of the rows where ``which`` is true, in a file if the map is in files."""
    places = which.nonzero()[:, 0]
    copy = MAP_MEMORY.rows(
        len(places),
        *rows.shape[1:],
        dtype=rows.dtype,
        device=rows.device,
    )
    MAP_MEMORY.give_back()
    return torch.index_select(rows, 0, places, out=copy)


def point_triangle_distance(
    xyz: Float[Tensor, "*N 3"], triangle: Float[Tensor, "*N 3 3"]
) -> Float[Tensor, "*N"]:
    """Distance from a point to a filled triangle, metres.

    The foot of the perpendicular is used if it lies inside; otherwise the nearest point is on one
    of the three edges. A triangle without area counts as its longest edge.

    Differentiable: no.
    """
    a, b, c = triangle.unbind(-2)
    normal = torch.linalg.cross(b - a, c - a)
    x = xyz.unbind(-1)
    n = normal.unbind(-1)
    corners = [corner.unbind(-1) for corner in (a, b, c)]
    squared = torch.full_like(x[0], math.inf)
    inside = _dot(n, n) > 0
    for p, q in zip(
        corners,
        corners[1:] + corners[:1],
        strict=True,
    ):
        edge = _difference(q, p)
        way = _difference(x, p)
        along = (_dot(way, edge) / _dot(edge, edge).clamp_min(1e-300)).clamp(0, 1)
        off = _difference(
            x,
            [start + along * step for start, step in zip(p, edge, strict=True)],
        )
        squared = torch.minimum(squared, _dot(off, off))
        inside = inside & (_dot(_cross(edge, way), n) >= 0)
    height = _dot(_difference(x, corners[0]), n).abs() / normal.norm(dim=-1).clamp_min(1e-300)
    return torch.where(inside, height, squared.sqrt())


Vectors = Sequence[Float[Tensor, "*N"]]
"""Vectors by component, which torch takes in whole registers; of rows of three it takes one number
at a time."""


def _difference(a: Vectors, b: Vectors) -> Vectors:
    return [p - q for p, q in zip(a, b, strict=True)]


def _dot(a: Vectors, b: Vectors) -> Float[Tensor, "*N"]:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _cross(a: Vectors, b: Vectors) -> Vectors:
    return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]


def _corners(
    mesh: Mesh,
    faces: Int[Tensor, " M"] | slice = slice(None),
) -> Float[Tensor, "M 3 3"]:
    return mesh.vertices_W[mesh.faces[faces].long()].double()


def _of_faces(
    mesh: Mesh, measure: Callable[[Float[Tensor, "M 3 3"]], Tensor], *width: int
) -> Tensor:
    """What ``measure`` gives for the corners of the faces, taken part by part to save memory."""
    check_shape("faces", mesh.faces, ("F", 3))
    check_finite("vertices_W", mesh.vertices_W)
    results = MAP_MEMORY.rows(
        len(mesh.faces), *width, dtype=torch.float64, device=mesh.faces.device
    )
    for start in range(0, len(mesh.faces), FACES_AT_A_TIME):
        part = slice(start, start + FACES_AT_A_TIME)
        results[part] = measure(_corners(mesh, part))
        MAP_MEMORY.give_back()
    return results


def _areas(mesh: Mesh) -> Float[Tensor, " F"]:
    return _of_faces(
        mesh,
        lambda x: torch.linalg.cross(x[:, 1] - x[:, 0], x[:, 2] - x[:, 0]).norm(dim=1) / 2,
    )


def _to_nearest(
    xyz: Float[Tensor, "N 3"],
    points: Float[Tensor, "M 3"],
) -> Float[Tensor, " N"]:
    """Distance from each point to the nearest of ``points``, on the CPU."""
    xyz = xyz.cpu()
    order = _by_place(xyz)
    distance = torch.empty(len(xyz), dtype=torch.float64)
    distance[order] = torch.from_numpy(_tree(points.cpu()).query(xyz[order].numpy())[0])
    return distance


def _tree(points: Float[Tensor, "M 3"]) -> "KDTree":
    """A search tree whose cells are halved in the middle: made in less than half the time, searched
    as fast."""
    from scipy.spatial import KDTree

    return KDTree(points.numpy(), balanced_tree=False, compact_nodes=False)


def _by_place(xyz: Float[Tensor, "N 3"]) -> Int[Tensor, " N"]:
    """An order of points in which neighbours are near each other: a tree is searched three times as
    fast in it."""
    if not len(xyz):
        return torch.zeros(0, dtype=torch.int64)
    cell = ((xyz - xyz.amin(0)) / CELL_M).long()
    n_cells = cell.amax(0) + 1
    return ((cell[:, 0] * n_cells[1] + cell[:, 1]) * n_cells[2] + cell[:, 2]).argsort()


def _scores(to_truth: Tensor, to_ours: Tensor, threshold_m: float) -> dict[str, float]:
    precision, recall = (
        float((distance < threshold_m).double().mean()) for distance in (to_truth, to_ours)
    )
    return {
        "accuracy_m": float(to_truth.cpu().numpy().mean()),
        "completion_m": float(to_ours.cpu().numpy().mean()),
        "precision": precision,
        "completion_ratio": recall,
        "f_score": 2 * precision * recall / (precision + recall) if precision + recall > 0 else 0.0,
        "threshold_m": threshold_m,
    }


def _distance(xyz: Tensor, mesh: Mesh, samples: tuple[Tensor, Tensor]) -> Tensor:
    """Distance of each point to ``mesh``, found through its ``samples`` and centroids, some faces
    after others."""
    xyz = xyz.cpu()
    points = samples[0].cpu()
    of_face = samples[1].cpu()
    nearest = _to_nearest(xyz, points)  # not more than this
    for start in range(0, len(mesh.faces), FACES_AT_A_TIME):
        corners = _corners(mesh, slice(start, start + FACES_AT_A_TIME)).cpu()
        low = corners.amin((0, 1))
        high = corners.amax((0, 1))
        middle = corners.mean(1)
        near = ((xyz - xyz.clamp(low, high)).norm(dim=1) <= nearest).nonzero()[:, 0]
        if not len(near):
            continue
        near = near[nearest[near].argsort()]  # those of a part have similar bounds
        extent = float((corners - middle[:, None]).norm(dim=2).max())
        here = (of_face >= start) & (of_face < start + len(corners))
        # samples represent large triangles, centroids those too small to have a sample
        tree = _tree(torch.cat([points[here], middle]))
        faces = torch.cat(
            [of_face[here] - start, torch.arange(len(corners)), torch.zeros(1, dtype=torch.int64)]
        )
        k = min(NEIGHBOURS, tree.n)
        for rows in near.split(20_000):
            rows = rows[_by_place(xyz[rows])]
            # a face whose middle is beyond is not nearer
            bound = 1.001 * (float(nearest[rows].max()) + extent)
            # tree.n if there are fewer
            index = tree.query(xyz[rows].numpy(), k=k, distance_upper_bound=bound)[1]
            candidates = faces[torch.from_numpy(index).reshape(len(rows), k)]
            for some, tried in zip(
                rows.split(POINTS_AT_A_TIME), candidates.split(POINTS_AT_A_TIME), strict=True
            ):
                found = point_triangle_distance(
                    xyz[some, None].expand(-1, k, 3), corners[tried]
                ).amin(1)
                nearest[some] = torch.minimum(nearest[some], found)
        MAP_MEMORY.give_back()
    return nearest
