"""Mesh scores on shapes whose distances are known, sampling, and what the frames have seen."""

import dataclasses
import math

import pytest
import torch

from gsfusion_nb.evaluation import (
    NotComputed,
    centres_to_own_mesh,
    cull_unseen,
    disc_scores,
    mesh_scores,
    point_distances,
    sample_discs,
    sample_surface,
    seen_by,
)
from gsfusion_nb.evaluation.triangles import point_triangle_distance
from gsfusion_nb.types import Camera, Frame, GaussianParams, Mesh


def mesh_of(vertices, faces):
    v = torch.as_tensor(vertices, dtype=torch.float32).reshape(-1, 3)
    return Mesh(
        vertices_W=v,
        faces=torch.as_tensor(faces, dtype=torch.int64).reshape(-1, 3),
        rgb=torch.zeros_like(v),
    )


def sphere(radius, rings=60, segments=120):
    """A latitude-longitude sphere."""
    theta = torch.linspace(0, math.pi, rings + 1, dtype=torch.float64)
    phi = torch.arange(segments, dtype=torch.float64) * 2 * math.pi / segments
    t, p = torch.meshgrid(theta, phi, indexing="ij")
    xyz = radius * torch.stack(
        [t.sin() * p.cos(), t.sin() * p.sin(), t.cos()],
        -1,
    )
    i, j = torch.meshgrid(
        torch.arange(rings),
        torch.arange(segments),
        indexing="ij",
    )
    a = i * segments + j
    b = i * segments + (j + 1) % segments
    c = a + segments
    d = b + segments
    return mesh_of(
        xyz,
        torch.cat(
            [torch.stack([a, c, b], -1).reshape(-1, 3), torch.stack([b, c, d], -1).reshape(-1, 3)]
        ),
    )


def square(x=0.0, y=0.0, z=0.0, size=1.0):
    return mesh_of(
        [[x, y, z], [x + size, y, z], [x + size, y + size, z], [x, y + size, z]],
        [[0, 1, 2], [0, 2, 3]],
    )


def gaussians_at(xyz):
    n = len(xyz)
    return GaussianParams(
        xyz_W=xyz,
        log_scale=xyz,
        quat=xyz.new_ones(n, 4),
        opacity_logit=xyz.new_zeros(n),
        sh=xyz.new_zeros(n, 1, 3),
    )


def joined(*meshes):
    offset = 0
    vertices = []
    faces = []
    for m in meshes:
        vertices.append(m.vertices_W)
        faces.append(m.faces + offset)
        offset += len(m.vertices_W)
    return mesh_of(torch.cat(vertices), torch.cat(faces))


def test_point_triangle_distance_by_hand():
    triangle = torch.tensor(
        [[0.0, 0, 0], [1, 0, 0], [0, 1, 0]],
        dtype=torch.float64,
    )
    points = {
        (0.2, 0.2, 0.5): 0.5,  # over the inside
        (0.2, 0.2, 0.0): 0.0,  # on it
        (0.5, -2.0, 0.0): 2.0,  # beside an edge
        (1.0, 1.0, 0.0): math.sqrt(0.5),  # beside the long edge
        (-3.0, -4.0, 0.0): 5.0,  # at a corner
        (2.0, 0.0, 1.0): math.sqrt(2),  # at another corner, above
    }
    xyz = torch.tensor(list(points), dtype=torch.float64)
    got = point_triangle_distance(xyz, triangle.expand(len(points), 3, 3))
    assert torch.allclose(got, torch.tensor(list(points.values()), dtype=torch.float64))


def test_point_triangle_distance_agrees_with_a_fine_search(generator):
    xyz = torch.randn(50, 3, generator=generator, dtype=torch.float64)
    triangle = torch.randn(50, 3, 3, generator=generator, dtype=torch.float64)
    n = 120
    i, j = torch.meshgrid(
        torch.arange(n + 1),
        torch.arange(n + 1),
        indexing="ij",
    )
    w = torch.stack([i, j, n - i - j], -1)[i + j <= n].double() / n
    searched = (torch.einsum("kb,nbc->nkc", w, triangle) - xyz[:, None]).norm(dim=-1).amin(1)
    got = point_triangle_distance(xyz, triangle)
    assert (got <= searched + 1e-12).all()
    assert (searched - got).max() < 0.03


def test_a_triangle_without_area_is_a_segment():
    flat = torch.tensor(
        [[[0.0, 0, 0], [1, 0, 0], [2, 0, 0]], [[1.0, 1, 1], [1, 1, 1], [1, 1, 1]]],
        dtype=torch.float64,
    )
    xyz = torch.tensor(
        [[0.5, 3.0, 0.0], [1.0, 1.0, 3.0]],
        dtype=torch.float64,
    )
    assert torch.allclose(
        point_triangle_distance(xyz, flat), torch.tensor([3.0, 2.0], dtype=torch.float64)
    )


def test_samples_lie_on_the_mesh_and_follow_area(generator):
    mesh = joined(square(size=1.0), square(x=5.0, size=2.0))
    xyz_W, face = sample_surface(mesh, 20_000, generator)
    on_large = xyz_W[:, 0] >= 5
    assert float(on_large.double().mean()) == pytest.approx(0.8, abs=0.01)
    assert torch.equal(on_large, face >= 2)
    small = xyz_W[~on_large]
    assert torch.allclose(
        small.mean(0),
        torch.tensor([0.5, 0.5, 0.0], dtype=torch.float64),
        atol=0.02,
    )
    assert float(small[:, 0].var()) == pytest.approx(1 / 12, rel=0.05)


def test_a_mesh_against_itself_is_perfect(generator):
    scores = mesh_scores(sphere(1.0), sphere(1.0), generator=generator, n_samples=5000)
    assert not isinstance(scores, NotComputed)
    assert scores["accuracy_m"] == pytest.approx(0, abs=1e-6)
    assert scores["completion_m"] == pytest.approx(0, abs=1e-6)
    assert (scores["precision"], scores["completion_ratio"], scores["f_score"]) == (1.0, 1.0, 1.0)


@pytest.mark.parametrize(("threshold", "share"), [(0.03, 1.0), (0.019, 0.0)])
def test_concentric_spheres_are_their_radii_apart(generator, threshold, share):
    scores = mesh_scores(
        sphere(1.02), sphere(1.0), generator=generator, threshold_m=threshold, n_samples=8000
    )
    assert not isinstance(scores, NotComputed)
    # facets: 1 - cos(pi / 120) = 3e-4 at most
    assert scores["accuracy_m"] == pytest.approx(0.02, abs=2e-4)
    assert scores["completion_m"] == pytest.approx(0.02, abs=2e-4)
    assert (scores["precision"], scores["completion_ratio"]) == (share, share)
    assert scores["f_score"] == share


@pytest.mark.parametrize("rings", [6, 150])
def test_distance_to_the_surface_needs_no_sample_on_each_triangle(generator, rings):
    """2,000 samples of a coarse mesh (72 triangles) and of a fine one (45,000)."""
    mesh = sphere(1.0, rings=rings, segments=rings)
    scores = mesh_scores(mesh, mesh, generator=generator, n_samples=2000)
    assert not isinstance(scores, NotComputed)
    # worst seen 7e-5, at the slivers around the poles; to samples it is 4e-2
    assert scores["accuracy_m"] < 2e-4


def test_a_part_of_the_mesh_that_is_far_from_all_points(generator, monkeypatch):
    """The truth is searched two faces at a time, and the second square is nobody's neighbour."""
    monkeypatch.setattr(point_distances, "FACES_AT_A_TIME", 2)
    truth = joined(square(), square(x=50.0))
    scores = mesh_scores(square(z=0.01), truth, generator=generator, n_samples=500)
    assert not isinstance(scores, NotComputed)
    assert scores["accuracy_m"] == pytest.approx(0.01, abs=1e-6)
    assert scores["completion_ratio"] == pytest.approx(0.5, abs=0.1)


def test_half_a_surface_is_precise_but_incomplete(generator):
    whole = joined(square(), square(x=1.0))
    scores = mesh_scores(square(), whole, generator=generator, threshold_m=0.1, n_samples=20_000)
    assert not isinstance(scores, NotComputed)
    assert scores["precision"] == 1.0
    assert scores["completion_ratio"] == pytest.approx(0.55, abs=0.01)
    # half at 0, half uniform in 0..1
    assert scores["completion_m"] == pytest.approx(0.25, abs=0.01)
    assert scores["f_score"] == pytest.approx(2 * 0.55 / 1.55, abs=0.01)


def test_a_mesh_without_faces_is_not_computed_and_an_empty_truth_is_an_error(generator):
    empty = mesh_of(torch.zeros(0, 3), torch.zeros(0, 3))
    assert mesh_scores(empty, square(), generator=generator) == NotComputed(
        "the reconstructed mesh has no faces"
    )
    with pytest.raises(ValueError, match="must have area, got 0 faces"):
        mesh_scores(square(), empty, generator=generator)
    with pytest.raises(ValueError, match="threshold_m must be > 0"):
        mesh_scores(square(), square(), generator=generator, threshold_m=0.0)


def front_frame(depth_m):
    camera = Camera(
        width=40,
        height=30,
        fx=40.0,
        fy=40.0,
        cx=20.0,
        cy=15.0,
    )
    return Frame(
        index=0,
        timestamp_s=0.0,
        rgb=torch.zeros(30, 40, 3),
        depth_m=depth_m,
        camera=camera,
        T_WC=torch.eye(4),
    )


def test_seen_means_in_the_image_and_not_behind_the_measured_depth():
    depth = torch.full((30, 40), 2.0)
    depth[:, :10] = 0.0
    xyz = torch.tensor(
        [
            [0.0, 0.0, 2.0],  # on the surface
            [0.0, 0.0, 2.04],  # within the tolerance behind it
            [0.0, 0.0, 2.06],  # behind it
            [0.0, 0.0, 1.0],  # in front
            [0.0, 0.0, -2.0],  # behind the camera
            [0.0, 0.0, 0.0],  # at the camera
            [5.0, 0.0, 2.0],  # outside the image
            [-0.8, 0.0, 2.0],  # at a pixel without depth (u = 4)
        ]
    )
    expected = [True, True, False, True, False, False, False, False]
    assert seen_by(xyz, [front_frame(depth)]).tolist() == expected
    assert not seen_by(xyz, []).any()


def test_seen_by_any_frame_uses_each_pose():
    moved = front_frame(torch.full((30, 40), 2.0))
    T = torch.eye(4)
    T[0, 3] = 5.0
    moved = dataclasses.replace(moved, T_WC=T)
    xyz = torch.tensor([[0.0, 0, 2], [5.0, 0, 2], [10.0, 0, 2]])
    frames = iter([front_frame(torch.full((30, 40), 2.0)), moved])
    assert seen_by(xyz, frames).tolist() == [True, True, False]


def test_culling_keeps_the_front_wall_and_renumbers():
    mesh = joined(
        square(-0.5, -0.5, 2.0),
        square(-0.5, -0.5, 3.0),
        square(4.0, -0.5, 2.0),
    )
    kept = cull_unseen(mesh, [front_frame(torch.full((30, 40), 2.0))])
    assert len(kept.faces) == 2
    assert torch.equal(kept.vertices_W[kept.faces], mesh.vertices_W[mesh.faces[:2]])
    assert len(kept.vertices_W) == len(kept.rgb) == 4
    nothing = cull_unseen(mesh, [front_frame(torch.zeros(30, 40))])
    assert len(nothing.faces) == len(nothing.vertices_W) == 0


def test_centres_against_the_own_mesh_in_closed_form(generator):
    """Far above a wall: its height. On the wall: nearest of random points of density 1 per cm^2,
    whose mean distance is 1 / (2 sqrt(density)) = 0.5 cm and whose mean square is 1 / (pi
    density)."""
    wall = square()
    xy = 0.2 + 0.6 * torch.rand(4000, 2, generator=generator, dtype=torch.float64)
    on = torch.cat(
        [xy, torch.zeros(4000, 1, dtype=torch.float64)],
        dim=1,
    )
    found = centres_to_own_mesh(
        gaussians_at(on + torch.tensor([0, 0, 2.0])), wall, generator=generator
    )
    assert found == (pytest.approx(2.0, abs=1e-4), pytest.approx(4.0, abs=4e-4))
    found = centres_to_own_mesh(gaussians_at(on), wall, generator=generator)
    assert found == (pytest.approx(0.005, rel=0.05), pytest.approx(1e-4 / math.pi, rel=0.1))


@pytest.mark.parametrize(
    ("xyz", "size_m", "word"),
    [
        ([], 1.0, "no Gaussian"),
        ([[0, 0, math.nan]], 1.0, "1 Gaussians"),
        ([[0.0, 0, 0]], 0.005, "1 cm^2"),
    ],
)
def test_without_centres_or_mesh_the_own_distance_says_why(generator, xyz, size_m, word):
    wall = square(size=size_m)
    points = torch.tensor(xyz, dtype=torch.float64).reshape(-1, 3)
    found = centres_to_own_mesh(gaussians_at(points), wall, generator=generator)
    assert isinstance(found, NotComputed)
    assert word in found.reason


def discs(*rows):
    """Discs of these centres, standard deviations and opacities, their axes those of the world."""
    xyz, scale_m, opacity = (
        torch.tensor(column, dtype=torch.float64) for column in zip(*rows, strict=True)
    )
    n = len(rows)
    quat = torch.tensor([1.0, 0, 0, 0], dtype=torch.float64).expand(n, 4).clone()
    return GaussianParams(
        xyz_W=xyz,
        log_scale=scale_m.log(),
        quat=quat,
        opacity_logit=opacity.logit(),
        sh=xyz.new_zeros(n, 1, 3),
    )


def test_points_are_spread_evenly_over_opaque_discs(generator):
    """Areas 2 x 1 and 1 x 0.5 times pi, so four of five points are on the first. Of a uniform
    ellipse the mean square along each axis is a quarter of its semi-axis squared, and no point is
    outside. The third disc is transparent."""
    first = ([0.0, 0, 0], [0.2, 0.001, 0.1], 0.9)
    second = ([5.0, 0, 0], [0.001, 0.1, 0.05], 0.6)
    third = ([9.0, 0, 0], [1.0, 1.0, 0.001], 0.4)
    points = sample_discs(discs(first, second, third), 20_000, generator)
    on_first = points[:, 0] < 2
    assert float(on_first.double().mean()) == pytest.approx(0.8, abs=0.01)
    assert float(points[:, 0].max()) < 6
    for at, centre, sizes in (
        (on_first, first[0], (0.2, 0.0, 0.1)),
        (~on_first, second[0], (0.0, 0.1, 0.05)),
    ):
        away = points[at] - torch.tensor(centre, dtype=torch.float64)
        assert away.square().mean(0).tolist() == pytest.approx(
            [s**2 / 4 for s in sizes], rel=0.05, abs=1e-12
        )
        axes = torch.tensor(sizes, dtype=torch.float64)
        assert (away[:, axes > 0] / axes[axes > 0]).norm(dim=1).max() <= 1
    assert sample_discs(discs(third), 10, generator).shape == (0, 3)


def test_discs_in_front_of_a_wall_in_closed_form(generator):
    """A disc of 5 cm before the middle of a wall of one metre, 2 cm away: it is accurate to 2 cm,
    and the wall is covered where it is less than 3 cm from the disc, so within 5 + sqrt(9 - 4) cm
    of the middle."""
    disc = discs(([0.5, 0.5, 0.02], [0.05, 0.05, 0.001], 0.9))
    scores = disc_scores(disc, square(), generator=generator, n_samples=30_000)
    assert isinstance(scores, dict)
    assert scores["accuracy_m"] == pytest.approx(0.02, rel=0.02)
    assert scores["precision"] == 1.0
    covered = math.pi * (0.05 + math.sqrt(0.03**2 - 0.02**2)) ** 2
    assert scores["completion_ratio"] == pytest.approx(covered, rel=0.05)
    assert scores["f_score"] == pytest.approx(2 * covered / (1 + covered), rel=0.05)
    assert scores["threshold_m"] == 0.03
    faint = discs(([0.5, 0.5, 0.02], [0.05, 0.05, 0.001], 0.1))
    assert disc_scores(faint, square(), generator=generator) == NotComputed(
        "the map has no opaque Gaussian"
    )


def test_the_image_ends_at_its_borders():
    """40 x 30 pixels, f = 40, at 2 m: from -1 to 1 and from -0.75 to 0.75 metres."""
    xyz = [
        [-0.999, 0, 2],
        [0.999, 0, 2],
        [0, -0.749, 2],
        [0, 0.749, 2],
        [-1.001, 0, 2],
        [1.001, 0, 2],
        [0, -0.751, 2],
    ]
    seen = seen_by(
        torch.tensor([*xyz, [0, 0.751, 2]]),
        [front_frame(torch.full((30, 40), 2.0))],
    )
    assert seen.tolist() == [True] * 4 + [False] * 4


def test_a_face_is_kept_by_its_middle_alone():
    """All corners of a large triangle are outside of the image, its centroid is in the middle of
    it."""
    large = mesh_of(
        [[-3.0, -2.0, 2.0], [3.0, -2.0, 2.0], [0.0, 4.0, 2.0]],
        [[0, 1, 2]],
    )
    frame = front_frame(torch.full((30, 40), 2.0))
    assert len(cull_unseen(large, [frame]).faces) == 1
    aside = mesh_of(large.vertices_W + torch.tensor([4.0, 0.0, 0.0]), large.faces)
    assert len(cull_unseen(aside, [frame]).faces) == 0
