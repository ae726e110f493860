"""The rule edge_discs: where its Gaussians are, and how they lie along an edge of the picture."""

import math

import pytest
import torch

from gsfusion_nb.geometry import quaternion, se3
from gsfusion_nb.seeding import SeedContext, apply_rule
from gsfusion_nb.seeding.image_features import structure_directions
from gsfusion_nb.seeding.rules.edge_discs import hexagonal_grid, quat_along
from gsfusion_nb.types import Camera, Frame

CAMERA = Camera(
    width=64,
    height=48,
    fx=50.0,
    fy=50.0,
    cx=32.0,
    cy=24.0,
)


def wall(angle_deg: float, T_WC=None) -> Frame:
    """A wall two metres ahead with a soft edge through the middle of the picture, at an angle to
    the u axis."""
    v, u = torch.meshgrid(
        torch.arange(48) + 0.5,
        torch.arange(64) + 0.5,
        indexing="ij",
    )
    angle = math.radians(angle_deg)
    away = (v - 24) * math.cos(angle) - (u - 32) * math.sin(angle)
    grey = torch.sigmoid(away / 2)
    return Frame(
        index=0,
        timestamp_s=0.0,
        rgb=grey[..., None].expand(-1, -1, 3).contiguous(),
        depth_m=torch.full((48, 64), 2.0),
        camera=CAMERA,
        T_WC=torch.eye(4) if T_WC is None else T_WC,
    )


@pytest.mark.parametrize("angle_deg", [0, 30, 90, 135])
def test_gaussians_on_an_edge_are_long_along_it(angle_deg):
    T_WC = se3.exp(torch.tensor([0.3, -0.2, 0.1, 0.4, 0.2, -0.3]))
    seeds = apply_rule(
        "edge_discs", SeedContext(wall(angle_deg, T_WC)), {"coverage": False, "stretch": 4.0}
    )
    xyz_C = se3.apply(se3.inverse(T_WC), seeds.xyz_W)
    uv = xyz_C[:, :2] / xyz_C[:, 2:] * 50 + torch.tensor([32.0, 24.0])
    angle = math.radians(angle_deg)
    away = (uv[:, 1] - 24) * math.cos(angle) - (uv[:, 0] - 32) * math.sin(angle)
    inside = ((uv > 5) & (uv < torch.tensor([59.0, 43.0]))).all(1)
    on_edge = seeds[(away.abs() < 1.5) & inside]
    assert len(on_edge) >= 5
    axes = quaternion.to_matrix(on_edge.quat)
    direction = (axes[:, :, 0] @ T_WC[:3, :3])[:, :2]  # of the longest axis, in the image
    along = torch.tensor([math.cos(angle), math.sin(angle)])
    assert float((direction @ along).abs().min()) > math.cos(math.radians(8))
    ratio = on_edge.scale_m[:, 0] / on_edge.scale_m[:, 1]
    assert 3.0 < float(ratio.min()) <= float(ratio.max()) <= 4.0
    area = (on_edge.scale_m[:, 0] * on_edge.scale_m[:, 1]).sqrt()
    assert torch.allclose(area, torch.tensor(2.0 * 0.7 * 4.0 / 50), rtol=1e-5)
    far = seeds[away.abs() > 18]
    assert torch.allclose(
        far.scale_m[:, 0],
        far.scale_m[:, 1],
        rtol=0.1,
    )  # no edge there: round
    assert torch.allclose(
        seeds.scale_m[:, 2],
        torch.tensor(0.2 * 2.0 * 0.7 * 4.0 / 50),
        rtol=1e-5,
    )


def test_discs_lie_in_the_surface(generator):
    normal = torch.nn.functional.normalize(torch.randn(50, 3, generator=generator), dim=1)
    normal[0] = 0.0  # unknown
    normal[1] = torch.tensor([1.0, 0.0, 0.0])  # seen from the side, along the edge
    along = torch.nn.functional.normalize(torch.randn(50, 2, generator=generator), dim=1)
    along[1] = torch.tensor([1.0, 0.0])
    T_WC = se3.exp(torch.tensor([0.0, 0.0, 0.0, 1.0, -0.5, 0.3]))
    axes = T_WC[:3, :3].T @ quaternion.to_matrix(quat_along(along, normal, T_WC))
    expected = normal.clone()
    expected[0] = torch.tensor([0.0, 0.0, -1.0])
    assert torch.allclose(axes[:, :, 2], expected, atol=1e-5)
    assert torch.allclose(
        torch.linalg.det(axes),
        torch.ones(50),
        atol=1e-5,
    )


def test_the_grid_is_regular_and_fills_the_picture():
    uv = hexagonal_grid(CAMERA, 8.0)
    distance = torch.cdist(uv, uv) + 1e3 * torch.eye(len(uv))
    assert float(distance.min()) == pytest.approx(8.0, abs=1e-4)
    assert len(uv) == pytest.approx(
        64 * 48 / (8 * 8 * math.sqrt(3) / 2),
        rel=0.1,
    )
    assert hexagonal_grid(CAMERA, 1000.0).shape == (1, 2)


def test_directions_of_a_ramp_and_of_nothing():
    v, u = torch.meshgrid(
        torch.arange(9.0),
        torch.arange(12.0),
        indexing="ij",
    )
    ramp = structure_directions((0.6 * u + 0.8 * v) / 30, 3)
    assert torch.allclose(
        ramp.direction.abs(),
        torch.tensor([0.8, 0.6]).expand(9, 12, 2),
        atol=1e-5,
    )
    slope2 = (1 / 30) ** 2
    assert torch.allclose(
        ramp.coherence,
        torch.full((9, 12), slope2 / (slope2 + 1e-4)),
        atol=1e-4,
    )
    assert not structure_directions(torch.full((5, 7), 0.4), 3).coherence.any()
    assert structure_directions(torch.rand(1, 1), 3).coherence.shape == (1, 1)
    with pytest.raises(ValueError, match="window_px must be odd"):
        structure_directions(ramp.coherence, 4)
