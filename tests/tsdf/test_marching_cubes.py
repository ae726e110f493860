import importlib
from collections import Counter

import pytest
import torch

from gsfusion_nb.config import TsdfConfig
from gsfusion_nb.data.room import room_sdf
from gsfusion_nb.tsdf import TsdfVolume, extract_mesh, integrate
from gsfusion_nb.tsdf.marching_cubes import EDGES, loops, triangle_table
from gsfusion_nb.tsdf.voxels import voxel_at

CONFIG = TsdfConfig(voxel_size_m=0.02, truncation_voxels=4.0)


def check_closed(mesh):
    """Every side is used once in each direction: closed, manifold along edges, consistently
    turned."""
    F = mesh.faces
    sides = torch.cat([F[:, [0, 1]], F[:, [1, 2]], F[:, [2, 0]]])
    key = sides[:, 0] * mesh.vertices_W.shape[0] + sides[:, 1]
    back = sides[:, 1] * mesh.vertices_W.shape[0] + sides[:, 0]
    assert key.unique().shape == key.shape
    assert torch.equal(key.sort().values, back.sort().values)
    assert F.unique().shape[0] == mesh.vertices_W.shape[0]


def signed_volume(mesh):
    a, b, c = mesh.vertices_W.double()[mesh.faces].unbind(1)
    return float((a * torch.linalg.cross(b, c)).sum() / 6)


def sphere(p, centre=(0.03, -0.02, 0.01), radius=0.3):
    return (p - torch.tensor(centre, dtype=p.dtype)).norm(dim=-1) - radius


def test_sphere_is_closed_round_and_turned_outwards(filled_volume):
    mesh = extract_mesh(
        filled_volume(
            sphere,
            (-3, -3, -3),
            (3, 3, 3),
        )
    )
    check_closed(mesh)
    V = mesh.vertices_W
    F = mesh.faces
    assert V.shape[0] - 3 * F.shape[0] // 2 + F.shape[0] == 2  # Euler: one sphere
    assert signed_volume(mesh) == pytest.approx(4 / 3 * torch.pi * 0.3**3, rel=0.01)
    # Linear interpolation of a distance field: h^2 / 8 R at most.
    assert float(sphere(V.double()).abs().max()) < 0.02**2 / (8 * 0.3) * 2
    a, b, c = V.double()[F].unbind(1)
    n = torch.linalg.cross(b - a, c - a)
    outward = ((a + b + c) / 3 - torch.tensor([0.03, -0.02, 0.01])).double()
    assert bool(((n * outward).sum(1) >= 0).all())


def test_random_field_is_closed(filled_volume, generator):
    """Noise has every case, and faces whose corners alternate."""
    volume = filled_volume(
        lambda p: torch.randn(p.shape[:-1], generator=generator).double(),
        (-2, -1, 0),
        (1, 2, 2),
    )
    border = TsdfVolume(CONFIG)
    low = volume.block_coords.amin(0) - 1
    high = volume.block_coords.amax(0) + 2
    axes = [torch.arange(int(a), int(b)) for a, b in zip(low, high, strict=True)]
    border.add_blocks(torch.stack(torch.meshgrid(*axes, indexing="ij"), dim=-1).view(-1, 3))
    border.W[:] = 1.0
    rows = border.index.find(volume.block_coords)
    border.D[rows] = volume.D
    mesh = extract_mesh(border)
    assert mesh.faces.shape[0] > 10000
    check_closed(mesh)


def test_only_where_all_corners_were_observed(camera, make_frame):
    """One view of a plane: one sheet, facing the camera; the far end of the band has no surface."""
    volume = TsdfVolume(CONFIG)
    integrate(volume, make_frame(torch.full((120, 160), 1.01), camera))
    mesh = extract_mesh(volume)
    assert mesh.faces.shape[0] > 1000
    assert float((mesh.vertices_W[:, 2] - 1.01).abs().max()) < 0.001
    a, b, c = mesh.vertices_W[mesh.faces].unbind(1)
    assert bool((torch.linalg.cross(b - a, c - a)[:, 2] < 0).all())
    # The colour runs with the image: red to the right (x), green downwards (y). Nothing is
    # mirrored.
    uv = mesh.vertices_W[:, :2] / 1.01 * torch.tensor([140.0, 150.0]) + torch.tensor([83.0, 57.5])
    torch.testing.assert_close(
        mesh.rgb[:, :2],
        uv / torch.tensor([160.0, 120.0]),
        atol=0.01,
        rtol=0,
    )
    assert extract_mesh(volume, min_weight=2.0).faces.shape == (0, 3)


def test_empty_volumes():
    for volume in (TsdfVolume(CONFIG), TsdfVolume(CONFIG)):
        mesh = extract_mesh(volume)
        assert mesh.vertices_W.shape == mesh.faces.shape == (0, 3)
        volume.add_blocks(torch.tensor([[0, 0, 0]]))
        assert extract_mesh(volume).faces.shape == (0, 3)


def test_the_rooms_surface(room_volume):
    """Against the exact distance field of the built-in room."""
    mesh = extract_mesh(room_volume[0])
    assert mesh.faces.shape[0] > 10_000
    distance_m = room_sdf(mesh.vertices_W.double()).abs()
    assert float(distance_m.median()) < 0.006
    assert float(distance_m.quantile(0.9)) < 0.03


def test_vertices_are_those_of_vtk(filled_volume):
    pyvista = pytest.importorskip("pyvista")

    def torus(p):
        x, y, z = (p - torch.tensor([0.013, 0.004, -0.007], dtype=p.dtype)).unbind(-1)
        return (((x * x + y * y).sqrt() - 0.2) ** 2 + z * z).sqrt() - 0.07

    volume = filled_volume(
        torus,
        (-2, -2, -1),
        (2, 2, 1),
    )
    mesh = extract_mesh(volume)
    check_closed(mesh)
    dense = torch.ones(32, 32, 16)
    for (x, y, z), D in zip(
        (volume.block_coords + torch.tensor([2, 2, 1])).tolist(),
        volume.D,
        strict=True,
    ):
        dense[8 * x : 8 * x + 8, 8 * y : 8 * y + 8, 8 * z : 8 * z + 8] = D.view(8, 8, 8)
    grid = pyvista.ImageData(
        dimensions=(32, 32, 16),
        spacing=(0.02,) * 3,
        origin=(-0.31, -0.31, -0.15),
    )
    grid["D"] = dense.permute(2, 1, 0).reshape(-1).numpy()
    theirs = torch.from_numpy(
        grid.contour([0.0], scalars="D", method="marching_cubes").points
    ).double()
    ours = mesh.vertices_W.double()
    assert theirs.shape == ours.shape
    distance = torch.cdist(ours, theirs)
    assert float(distance.amin(0).max()) < 1e-6
    assert float(distance.amin(1).max()) < 1e-6


def inside(case, corner):
    return bool(case >> corner & 1)


def test_one_corner_by_hand():
    table, count = triangle_table()
    assert count[0] == count[255] == 0
    assert count[1] == count[254] == 1
    # Corner 0 inside: the triangle joins the x, y and z edges at it, counter-clockwise seen from
    # (1, 1, 1).
    x = EDGES.index((0, 0))
    y = EDGES.index((1, 0))
    z = EDGES.index((2, 0))
    assert table[1, 0].tolist() in ([x, y, z], [y, z, x], [z, x, y])
    assert table[254, 0].tolist() in ([x, z, y], [z, y, x], [y, x, z])


def test_triangles_use_every_cut_edge_and_no_other():
    table, count = triangle_table()
    assert table.shape == (256, 5, 3)
    for case in range(256):
        cut = {
            e
            for e, (axis, low) in enumerate(EDGES)
            if inside(case, low) != inside(case, low | 1 << axis)
        }
        assert set(table[case, : count[case]].flatten().tolist()) == cut
        assert {e for loop in loops(case) for e in loop} == cut


def test_open_border_lies_in_the_faces_and_nothing_else_does():
    """Sides used once bound the patch and lie in cube faces; sides used twice run through the
    interior only."""
    table, count = triangle_table()
    corners = [{low, low | 1 << axis} for axis, low in EDGES]
    faces = [{c for c in range(8) if (c >> a & 1) == s} for a in range(3) for s in (0, 1)]
    for case in range(256):
        sides = Counter()
        for t in table[case, : count[case]].tolist():
            sides.update((t[i], t[(i + 1) % 3]) for i in range(3))
        assert max(sides.values(), default=1) == 1  # a directed side belongs to one triangle
        for a, b in sides:
            in_face = any(corners[a] <= face and corners[b] <= face for face in faces)
            assert in_face == ((b, a) not in sides)


def test_neighbouring_cubes_agree_on_their_face():
    """Directed sides in the shared face run in opposite directions, whatever the other corners
    are."""
    table, count = triangle_table()

    def border(case, axis, side):
        face = {c for c in range(8) if (c >> axis & 1) == side}
        found = set()
        for t in table[case, : count[case]].tolist():
            for a, b in ((t[0], t[1]), (t[1], t[2]), (t[2], t[0])):
                ends = [{EDGES[e][1], EDGES[e][1] | 1 << EDGES[e][0]} for e in (a, b)]
                if ends[0] <= face and ends[1] <= face:
                    # drop the coordinate across the face, so that both cubes name the edge alike
                    found.add(tuple((EDGES[e][0], EDGES[e][1] & ~(1 << axis)) for e in (a, b)))
        return found

    generator = torch.Generator().manual_seed(0)
    for axis in range(3):
        low_corners = [c for c in range(8) if not c >> axis & 1]
        for pattern in range(16):
            bits = [(c, pattern >> i & 1) for i, c in enumerate(low_corners)]
            for _ in range(4):
                left, right = torch.randint(0, 256, (2,), generator=generator).tolist()
                for c, bit in bits:
                    high = c | 1 << axis
                    left = left & ~(1 << high) | bit << high
                    right = right & ~(1 << c) | bit << c
                assert border(left, axis, 1) == {(b, a) for a, b in border(right, axis, 0)}


def test_a_vertex_has_the_colour_of_its_place(filled_volume):
    """Colour runs linearly through space, so between two voxels it must be that of the point."""
    volume = filled_volume(
        sphere,
        (-3, -3, -3),
        (3, 3, 3),
    )

    def colour(p):
        return 0.5 + p @ torch.tensor([[0.4, 0.1, 0.0], [-0.2, 0.5, 0.1], [0.1, 0.0, -0.6]])

    centres = (voxel_at(volume.block_coords, torch.arange(volume.n_blocks * 512)) + 0.5) * 0.02
    volume.rgb_planes.copy_(colour(centres).view(-1, 512, 3).transpose(1, 2))
    mesh = extract_mesh(volume)
    torch.testing.assert_close(
        mesh.rgb,
        colour(mesh.vertices_W),
        atol=1e-5,
        rtol=0,
    )


def test_sphere_far_away_with_negative_coordinates(filled_volume):
    centre = (-70.0, 33.0, -12.5)
    low = [int((c - 0.4) // 0.16) for c in centre]
    volume = filled_volume(
        lambda p: sphere(p, centre),
        low,
        [b + 6 for b in low],
    )
    mesh = extract_mesh(volume)
    check_closed(mesh)
    assert float(sphere(mesh.vertices_W.double(), centre).abs().max()) < 2e-4  # h^2 / 8 R again


def test_chunks_do_not_show(filled_volume, monkeypatch):
    volume = filled_volume(
        sphere,
        (-3, -3, -3),
        (3, 3, 3),
    )
    whole = extract_mesh(volume)
    module = importlib.import_module("gsfusion_nb.tsdf.marching_cubes")
    monkeypatch.setattr(module, "BLOCKS_AT_A_TIME", 7)
    parts = extract_mesh(volume)
    assert torch.equal(whole.vertices_W, parts.vertices_W)
    assert torch.equal(whole.faces, parts.faces)
    assert torch.equal(whole.rgb, parts.rgb)
