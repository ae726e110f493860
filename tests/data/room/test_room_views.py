"""Rendered views of the room, against closed forms, sphere tracing, and one another; distances and
charts of its solids, against by-hand values and brute force."""

import numpy as np
import pytest
import torch

from gsfusion_nb.data.room import render_room, room_sdf
from gsfusion_nb.data.room.camera import look_at
from gsfusion_nb.data.room.drawings import text_poster
from gsfusion_nb.data.room.interior import interior
from gsfusion_nb.data.room.painted import ball, box, cone, plain
from gsfusion_nb.data.room.solids import face_axes
from gsfusion_nb.geometry import depth_to_points, pixel_grid, project, rays, se3
from gsfusion_nb.types import Camera

CAMERA = Camera(
    width=80,
    height=60,
    fx=52.0,
    fy=52.0,
    cx=40.0,
    cy=30.0,
)


def pose(eye, target):
    return torch.from_numpy(look_at(np.array(eye, float), np.array(target, float)))


VIEWS = [
    pose((1.9, -1.4, 1.6), (-1.2, 0.6, 0.9)),
    pose((-1.2, 1.4, 1.5), (1.0, -1.8, 1.0)),
    pose((0.75, 0.0, 1.2), (1.7, 0.6, 0.8)),
    pose((1.2, 1.2, 1.1), (2.1, 1.5, 0.8)),
]


def test_wall_depth_is_the_closed_form():
    T_WC = pose((-0.1, 0.0, 2.45), (-2.5, 0.0, 2.45))
    _, depth_m = render_room(CAMERA, T_WC)
    near_axis = depth_m[:, 20:60][28:32]
    torch.testing.assert_close(
        near_axis,
        torch.full_like(near_axis, 2.4),
        atol=2e-6,
        rtol=0,
    )
    # The ceiling, 0.15 m above: z = 0.15 fy / (cy - v) wherever that is nearer than the wall.
    v = torch.arange(20) + 0.5
    torch.testing.assert_close(
        depth_m[:20, 40],
        0.15 * CAMERA.fy / (CAMERA.cy - v),
        atol=2e-6,
        rtol=0,
    )


@pytest.mark.parametrize("T_WC", VIEWS)
def test_every_hit_lies_on_the_surface(T_WC):
    rgb, depth_m = render_room(CAMERA, T_WC)
    assert rgb.dtype == depth_m.dtype == torch.float32
    assert (depth_m > 0.2).all()
    assert rgb.min() >= 0
    assert rgb.max() <= 1
    points = se3.apply(T_WC, depth_to_points(CAMERA, depth_m.double()))
    assert room_sdf(points).abs().max() < 1e-5  # worst seen 5e-7


def test_first_hits_agree_with_sphere_tracing():
    """The witness knows only the distance function: it walks along rays until it is within 0.01 mm
    of something."""
    uv = pixel_grid(CAMERA, dtype=torch.float64)[2::7, 3::9].reshape(-1, 2)
    views = VIEWS[:2]  # their rays go together: a step costs the same for many points as for few
    ray = torch.cat([se3.rotate(T_WC, rays(CAMERA, uv)) for T_WC in views])
    origin = torch.cat([T_WC[:3, 3].expand(len(uv), 3) for T_WC in views])
    found = torch.cat(
        [render_room(CAMERA, T_WC)[1][2::7, 3::9].reshape(-1).double() for T_WC in views]
    )
    z = torch.zeros(len(ray), dtype=torch.float64)
    for _ in range(120):
        z += room_sdf(origin + z[:, None] * ray) / ray.norm(dim=1)
    for n in (slice(0, len(uv)), slice(len(uv), None)):
        assert (room_sdf(origin[n] + z[n, None] * ray[n]) < 1e-5).double().mean() > 0.97
        # grazing rays have not arrived yet
        assert ((z - found)[n].abs() < 1e-3).double().mean() > 0.97
        assert (z <= found + 1e-4)[n].all()


def test_points_keep_their_colour_between_views():
    a = pose((0.3, -0.4, 1.5), (-2.4, 0.3, 0.9))
    b = pose((-0.3, 0.5, 1.4), (-2.4, 0.1, 0.9))
    camera = CAMERA.resized(160, 120)
    rgb_a, depth_a = render_room(camera, a)
    rgb_b, depth_b = render_room(camera, b)
    xyz_B = se3.apply(se3.inverse(b) @ a, depth_to_points(camera, depth_a.double())).reshape(-1, 3)
    uv = project(camera, xyz_B)
    col = uv[:, 0].floor().long()
    row = uv[:, 1].floor().long()
    inside = (col >= 0) & (col < 160) & (row >= 0) & (row < 120) & (xyz_B[:, 2] > 0)
    col = col[inside]
    row = row[inside]
    z = xyz_B[inside, 2]
    seen = (depth_b[row, col] - z).abs() < 0.01
    difference = (rgb_a.reshape(-1, 3)[inside][seen] - rgb_b[row, col][seen]).abs().mean(1)
    assert seen.double().mean() > 0.7
    assert difference.median() < 0.012
    assert difference.quantile(0.9) < 0.08


def test_text_is_not_mirrored():
    """The poster seen from the front looks like its drawing, and not like the drawing's mirror
    image."""
    import cv2

    lines = [
        "every pixel is a ray",
        "every voxel an average",
        "every splat a guess",
        "keep what is seen twice",
    ]
    colours = ((0.95, 0.93, 0.86), (0.13, 0.15, 0.2), (0.75, 0.25, 0.15))
    poster = text_poster(
        306, 444, 0.0018, None, "MAP THE ROOM", [*lines, "forget the rest"], *colours
    )
    drawn = cv2.resize(poster, (55, 80), interpolation=cv2.INTER_AREA)
    camera = Camera(
        width=55,
        height=80,
        fx=100.0,
        fy=100.0,
        cx=27.5,
        cy=40.0,
    )
    rgb, _ = render_room(
        camera,
        pose((-2.475 + 1.0, -0.42, 1.6), (-2.5, -0.42, 1.6)),
    )
    seen = rgb.mean(-1).numpy()
    wanted = drawn.mean(-1)
    assert np.corrcoef(seen.ravel(), wanted.ravel())[0, 1] > 0.97
    odd_seen = seen - seen[:, ::-1]  # changes sign under mirroring
    odd_wanted = wanted - wanted[:, ::-1]
    assert np.corrcoef(odd_seen.ravel(), odd_wanted.ravel())[0, 1] > 0.8


GREY = plain(0.5, 0.5, 0.5)
SOLIDS = {
    "box": box((0, 0, 0), (0.4, 0.6, 0.2), GREY),
    "rounded box": box(
        (0, 0, 0),
        (0.4, 0.6, 0.2),
        GREY,
        radius=0.05,
    ),
    "cylinder": cone((0, 0, -0.2), 0.4, (0.1, 0.1), GREY),
    "cone": cone((0, 0, -0.2), 0.4, (0.25, 0.1), GREY),
    "sphere": ball((0, 0, 0), 0.2, GREY),
    "leaf": ball((0, 0, 0), (0.12, 0.05, 0.006), GREY),
}


def test_distances_by_hand():
    at = np.array([[0.5, 0.0, 0.0], [0.2, 0.3, 0.4], [0.0, 0.0, 0.0]])
    np.testing.assert_allclose(
        SOLIDS["box"].sdf(at),
        [0.3, 0.3, -0.1],
        atol=1e-12,
    )
    corner = np.array([[0.2, 0.3, 0.1]])
    np.testing.assert_allclose(
        SOLIDS["rounded box"].sdf(corner),
        0.05 * (np.sqrt(3) - 1),
        atol=1e-12,
    )
    np.testing.assert_allclose(
        SOLIDS["cylinder"].sdf(np.array([[0.4, 0, 0], [0, 0, 0.5]])),
        [0.3, 0.3],
        atol=1e-12,
    )
    np.testing.assert_allclose(
        SOLIDS["sphere"].sdf(np.array([[0.0, 0.5, 0.0]])),
        0.3,
        atol=1e-12,
    )
    np.testing.assert_allclose(
        SOLIDS["leaf"].sdf(np.array([[0.2, 0, 0], [0, 0, 0.1]])),
        [0.08, 0.094],
        atol=1e-9,
    )


@pytest.mark.parametrize("name", SOLIDS)
def test_distance_is_that_to_the_nearest_surface_point(name):
    solid = SOLIDS[name]
    u, v = (a.ravel() for a in np.meshgrid(np.linspace(0, 1, 241), np.linspace(0, 1, 241)))
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (40, 3))
    distance = solid.sdf(points)
    brute = np.full(40, np.inf)
    for face in solid.faces:
        surface, _ = solid.surface(face, u, v)
        np.testing.assert_allclose(solid.sdf(surface), 0.0, atol=1e-9)
        for piece in np.array_split(surface, 8):
            gaps = np.linalg.norm(points[:, None] - piece[None], axis=-1)
            brute = np.minimum(brute, gaps.min(1))
    outside = distance > 0
    assert outside.sum() > 20
    # brute force has gaps of 3 mm
    np.testing.assert_allclose(distance[outside], brute[outside], atol=4e-4)


@pytest.mark.parametrize("name", ["rounded box", "cylinder", "cone", "sphere", "leaf"])
def test_chart_inverts_surface(name):
    solid = SOLIDS[name]
    u, v = (
        a.ravel() for a in np.meshgrid(np.linspace(0.03, 0.97, 23), np.linspace(0.03, 0.97, 19))
    )
    faces = solid.faces if name == "rounded box" else solid.faces[:1]
    for number, face in enumerate(faces):
        p, n = solid.surface(face, u, v)
        found, u2, v2 = solid.chart(p)
        assert (found == number).all()
        np.testing.assert_allclose(u2, u, atol=1e-9)
        np.testing.assert_allclose(v2, v, atol=1e-9)
        np.testing.assert_allclose(
            np.linalg.norm(n, axis=-1),
            1.0,
            atol=1e-12,
        )
        assert (solid.sdf(p + 0.001 * n) > 0.0009).all()


def test_the_arrangement_repeats_by_seed():
    one, two, other = (interior(seed) for seed in (3, 3, 4))
    assert all(
        np.array_equal(a.t, b.t) and np.array_equal(a.extent, b.extent)
        for a, b in zip(one, two, strict=True)
    )
    assert len(one) != len(other) or not all(
        np.array_equal(a.t, b.t) for a, b in zip(one, other, strict=True)
    )


def test_face_axes_are_right_handed_as_seen_from_outside():
    for face in ("x-", "x+", "y-", "y+", "z-", "z+"):
        right, up, normal = face_axes(face)
        np.testing.assert_array_equal(np.cross(right, up), normal)
