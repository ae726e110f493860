"""Distances and charts of the room's solids, against by-hand values and brute force."""

import numpy as np
import pytest

from gsfusion_nb.data.room.build import ball, box, cone, plain
from gsfusion_nb.data.room.solids import face_axes

GREY = plain(0.5, 0.5, 0.5)
SOLIDS = {
    "box": box((0, 0, 0), (0.4, 0.6, 0.2), GREY),
    "rounded box": box((0, 0, 0), (0.4, 0.6, 0.2), GREY, radius=0.05),
    "cylinder": cone((0, 0, -0.2), 0.4, (0.1, 0.1), GREY),
    "cone": cone((0, 0, -0.2), 0.4, (0.25, 0.1), GREY),
    "sphere": ball((0, 0, 0), 0.2, GREY),
    "leaf": ball((0, 0, 0), (0.12, 0.05, 0.006), GREY),
}


def test_distances_by_hand():
    at = np.array([[0.5, 0.0, 0.0], [0.2, 0.3, 0.4], [0.0, 0.0, 0.0]])
    np.testing.assert_allclose(SOLIDS["box"].sdf(at), [0.3, 0.3, -0.1], atol=1e-12)
    corner = np.array([[0.2, 0.3, 0.1]])
    np.testing.assert_allclose(SOLIDS["rounded box"].sdf(corner), 0.05 * (np.sqrt(3) - 1), atol=1e-12)
    np.testing.assert_allclose(SOLIDS["cylinder"].sdf(np.array([[0.4, 0, 0], [0, 0, 0.5]])), [0.3, 0.3], atol=1e-12)
    np.testing.assert_allclose(SOLIDS["sphere"].sdf(np.array([[0.0, 0.5, 0.0]])), 0.3, atol=1e-12)
    np.testing.assert_allclose(SOLIDS["leaf"].sdf(np.array([[0.2, 0, 0], [0, 0, 0.1]])), [0.08, 0.094], atol=1e-9)


@pytest.mark.parametrize("name", SOLIDS)
def test_distance_is_that_to_the_nearest_surface_point(name):
    solid = SOLIDS[name]
    u, v = (a.ravel() for a in np.meshgrid(np.linspace(0, 1, 241), np.linspace(0, 1, 241)))
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (40, 3))
    distance, brute = solid.sdf(points), np.full(40, np.inf)
    for face in solid.faces:
        surface, _ = solid.surface(face, u, v)
        np.testing.assert_allclose(solid.sdf(surface), 0.0, atol=1e-9)
        for piece in np.array_split(surface, 8):
            gaps = np.linalg.norm(points[:, None] - piece[None], axis=-1)
            brute = np.minimum(brute, gaps.min(1))
    outside = distance > 0
    assert outside.sum() > 20
    np.testing.assert_allclose(distance[outside], brute[outside], atol=4e-4)  # brute force has gaps of 3 mm


@pytest.mark.parametrize("name", ["rounded box", "cylinder", "cone", "sphere", "leaf"])
def test_chart_inverts_surface(name):
    solid = SOLIDS[name]
    u, v = (a.ravel() for a in np.meshgrid(np.linspace(0.03, 0.97, 23), np.linspace(0.03, 0.97, 19)))
    faces = solid.faces if name == "rounded box" else solid.faces[:1]
    for number, face in enumerate(faces):
        p, n = solid.surface(face, u, v)
        found, u2, v2 = solid.chart(p)
        assert (found == number).all()
        np.testing.assert_allclose(u2, u, atol=1e-9)
        np.testing.assert_allclose(v2, v, atol=1e-9)
        np.testing.assert_allclose(np.linalg.norm(n, axis=-1), 1.0, atol=1e-12)
        assert (solid.sdf(p + 0.001 * n) > 0.0009).all()


def test_face_axes_are_right_handed_as_seen_from_outside():
    for face in ("x-", "x+", "y-", "y+", "z-", "z+"):
        right, up, normal = face_axes(face)
        np.testing.assert_array_equal(np.cross(right, up), normal)
