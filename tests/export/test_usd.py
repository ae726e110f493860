"""Gaussians, mesh and cameras in an OpenUSD stage, read back by usd-core."""

import pytest
import torch

from gsfusion_nb.export import write_map_usda
from gsfusion_nb.geometry import se3
from gsfusion_nb.geometry.upright import turn_to_y_up
from gsfusion_nb.types import Camera, GaussianParams, Mesh

Usd, UsdGeom, Gf = (
    pytest.importorskip(f"pxr.{name}", reason="usd-core is not installed")
    for name in ("Usd", "UsdGeom", "Gf")
)

CAMERA = Camera(
    width=64,
    height=48,
    fx=60.0,
    fy=58.0,
    cx=31.3,
    cy=24.9,
)
MESH = Mesh(
    vertices_W=torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 3]]),
    faces=torch.tensor([[0, 2, 1], [0, 1, 3], [1, 2, 3]], dtype=torch.int32),
    rgb=torch.tensor([[0.0, 0.02, 1], [0.2, 0.4, 0.6], [1, 0, 0], [0.2, 0.4, 1.5]]),
)


@pytest.fixture
def gaussians(generator):
    def rand(*shape):
        return torch.randn(*shape, generator=generator)

    return GaussianParams(
        xyz_W=rand(7, 3),
        log_scale=rand(7, 3) - 2,
        quat=rand(7, 4),
        opacity_logit=2 * rand(7),
        sh=rand(7, 9, 3),
    )


@pytest.fixture
def poses():
    twists = torch.tensor(
        [[0.1, 0.2, -0.3, 0.4, 0.7, 0.1], [-0.5, 0.1, 0.2, -0.3, 0.2, 0.6]],
        dtype=torch.float64,
    )
    return torch.stack([se3.exp(twist) for twist in twists])


def opened(path):
    stage = Usd.Stage.Open(str(path))
    return stage, {prim.GetName(): prim for prim in stage.Traverse()}


def values(prim, name):
    attribute = prim.GetAttribute(name)
    assert not attribute.IsCustom(), f"the schema of {prim.GetTypeName()} has no {name}"
    return torch.tensor([list(v) if hasattr(v, "__len__") else v for v in attribute.Get()])


def test_the_numbers_are_those_of_the_map(tmp_path, gaussians):
    write_map_usda(tmp_path / "map.usda", gaussians, MESH)
    stage, prims = opened(tmp_path / "map.usda")
    splats = prims["Gaussians"]
    surface = prims["Surface"]
    assert splats.GetTypeName() == "ParticleField3DGaussianSplat"
    assert splats.IsDefined()
    assert torch.equal(values(splats, "positions"), gaussians.xyz_W)
    assert torch.equal(
        values(splats, "scales"),
        gaussians.log_scale.double().exp().float(),
    )
    assert torch.equal(
        values(splats, "opacities"), gaussians.opacity_logit.double().sigmoid().float()
    )
    assert splats.GetAttribute("radiance:sphericalHarmonicsDegree").Get() == 2
    assert torch.equal(
        values(splats, "radiance:sphericalHarmonicsCoefficients"), gaussians.sh.flatten(0, 1)
    )
    turns = [[q.real, *q.imaginary] for q in splats.GetAttribute("orientations").Get()]
    assert torch.allclose(
        torch.tensor(turns),
        torch.nn.functional.normalize(gaussians.quat, dim=1),
        atol=1e-6,
    )
    assert torch.equal(values(surface, "points"), MESH.vertices_W)
    assert values(surface, "faceVertexIndices").tolist() == MESH.faces.flatten().tolist()
    assert values(surface, "primvars:displayColor")[1].tolist() == pytest.approx(
        [0.0331, 0.1329, 0.3185], abs=1e-4
    )
    assert (stage.GetMetadata("upAxis"), stage.GetMetadata("metersPerUnit")) == ("Y", 1)


@pytest.mark.parametrize("up", ["-y", "+z", (0.3, 0.1, -0.9)])
def test_the_root_turns_up_to_y(tmp_path, gaussians, up):
    write_map_usda(tmp_path / "map.usda", gaussians, up=up)
    _, prims = opened(tmp_path / "map.usda")
    T = UsdGeom.Xformable(prims["Gaussians"]).ComputeLocalToWorldTransform(0)
    for point in torch.eye(3).tolist():
        expected = turn_to_y_up(up) @ torch.tensor(point, dtype=torch.float64)
        assert list(T.Transform(Gf.Vec3d(*point))) == pytest.approx(expected.tolist(), abs=1e-12)


def test_usds_camera_sees_a_point_at_our_pixel(tmp_path, gaussians, poses):
    path = tmp_path / "map.usda"
    times_s = [1.5, 1700000000.125]
    write_map_usda(path, gaussians, camera=CAMERA, poses=poses, times_s=times_s, up="+z")
    stage, prims = opened(path)
    assert (stage.GetStartTimeCode(), stage.GetEndTimeCode()) == tuple(times_s)
    for time_s, T_WC in zip(times_s, poses, strict=True):
        frustum = UsdGeom.Camera(prims["Camera"]).GetCamera(time_s).frustum
        to_film = frustum.ComputeViewMatrix() * frustum.ComputeProjectionMatrix()
        for u, v, z_m in ((5.0, 40.0, 2.0), (31.3, 24.9, 1.0), (60.0, 3.0, 0.5)):
            xyz_C = (
                torch.tensor(
                    [(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, 1.0]
                ).double()
                * z_m
            )
            xyz = turn_to_y_up("+z") @ se3.apply(T_WC, xyz_C)
            x, y, _ = to_film.Transform(Gf.Vec3d(*xyz.tolist()))
            seen = ((x + 1) / 2 * CAMERA.width, (1 - y) / 2 * CAMERA.height)
            assert seen == pytest.approx((u, v), abs=1e-4)


def test_what_cannot_be_written_is_refused(tmp_path, gaussians, poses):
    with pytest.raises(ValueError, match="times_s must hold 2 times"):
        write_map_usda(tmp_path / "map.usda", gaussians, camera=CAMERA, poses=poses, times_s=[0.0])
    gaussians.xyz_W[2, 1] = float("nan")
    with pytest.raises(ValueError, match="xyz_W of 1 Gaussians is NaN"):
        write_map_usda(tmp_path / "map.usda", gaussians)
    assert list(tmp_path.iterdir()) == []


def test_an_empty_map_is_a_stage(tmp_path, gaussians):
    write_map_usda(tmp_path / "map.usda", gaussians[:0])
    assert list(opened(tmp_path / "map.usda")[1]) == ["Map"]
