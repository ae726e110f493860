"""Colours of vertices against the pixels that show them."""

import pytest
import torch

from gsfusion_nb.evaluation import NotComputed, mesh_psnr
from gsfusion_nb.types import Camera, Frame, Mesh

CAMERA = Camera(width=8, height=6, fx=8.0, fy=8.0, cx=4.0, cy=3.0)


def frame(depth_m=2.0):
    """A wall in front of the camera; the colour of a pixel says where it is."""
    row, column = torch.meshgrid(torch.arange(6) / 10, torch.arange(8) / 10, indexing="ij")
    rgb = torch.stack([column, row, torch.full_like(row, 0.5)], dim=-1)
    return Frame(
        index=0, timestamp_s=0.0, rgb=rgb, depth_m=torch.full((6, 8), depth_m), camera=CAMERA, T_WC=torch.eye(4)
    )


def at(column, row, z_m, rgb):
    """A vertex behind the centre of a pixel."""
    return [(column + 0.5 - 4.0) / 8.0 * z_m, (row + 0.5 - 3.0) / 8.0 * z_m, z_m], rgb


def mesh_of(*vertices):
    return Mesh(
        vertices_W=torch.tensor([xyz for xyz, _ in vertices]),
        faces=torch.zeros(0, 3, dtype=torch.int64),
        rgb=torch.tensor([rgb for _, rgb in vertices]),
    )


def test_vertices_are_compared_with_their_pixels_and_hidden_ones_are_not():
    vertices = [
        at(3, 1, 2.0, [0.3, 0.1, 0.7]),  # blue is wrong by 0.2
        at(5, 4, 2.015, [0.5, 0.4, 0.5]),
        at(2, 2, 2.3, [1.0, 1.0, 1.0]),  # behind the wall
        at(2, 3, 1.7, [1.0, 1.0, 1.0]),  # nothing was seen there
        at(9, 2, 2.0, [1.0, 1.0, 1.0]),  # outside the picture
        at(2, 3, -2.0, [1.0, 1.0, 1.0]),  # behind the camera
    ]
    expected = -10 * torch.tensor(0.2**2 / 6).log10()
    assert mesh_psnr(mesh_of(*vertices), [frame()]) == pytest.approx(float(expected), abs=1e-3)
    assert mesh_psnr(mesh_of(*vertices), [frame(), frame(5.0)]) == pytest.approx(float(expected), abs=1e-3)


def test_no_number_if_no_view_shows_the_mesh():
    assert mesh_psnr(mesh_of(at(3, 1, 2.0, [0.5] * 3)), [frame(5.0)]) == NotComputed(
        "no view shows a vertex of the mesh"
    )
