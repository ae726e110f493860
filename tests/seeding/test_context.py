"""What a rule is given: seeds from cells, voxel lookups, views of the map."""

import dataclasses
import math
from types import SimpleNamespace

import pytest
import torch

from gsfusion_nb.config import SeedingConfig, TsdfConfig
from gsfusion_nb.gaussians import GaussianModel
from gsfusion_nb.geometry import project, quaternion, se3
from gsfusion_nb.render import project_gaussians
from gsfusion_nb.seeding import SeedContext, as_discs, check_contexts, voxel_index
from gsfusion_nb.seeding.discs import cell_on_plane, over_cells
from gsfusion_nb.seeding.quadtree import Cells
from gsfusion_nb.types import Camera, Frame, Seeds


def frame(
    depth_m: torch.Tensor,
    rgb: torch.Tensor | None = None,
    fx: float = 600.0,
    T_WC=None,
) -> Frame:
    H, W = depth_m.shape
    return Frame(
        index=0,
        timestamp_s=0.0,
        rgb=torch.rand(H, W, 3, generator=torch.Generator().manual_seed(1)) if rgb is None else rgb,
        depth_m=depth_m,
        camera=Camera(width=W, height=H, fx=fx, fy=500.0, cx=W / 2, cy=H / 2),
        T_WC=torch.eye(4) if T_WC is None else T_WC,
    )


class FakeVolume:
    """Weight = number of the voxel along x."""

    config = TsdfConfig(voxel_size_m=0.5, near_m=0.7)

    def sample_nearest(self, xyz_W):
        i = (xyz_W[:, 0] / 0.5).floor()
        return SimpleNamespace(D=0.1 * i, W=i, rgb=xyz_W * 0)


def test_published_size_of_a_cell():
    """Depth 2 m, 4 x 2 pixels, fx 600: d = 0.00745356, log d = -4.899064; fy plays no part."""
    seeds = SeedContext(frame(torch.full((2, 4), 2.0))).cells(thickness=1.0, opacity=0.5)
    assert len(seeds) == 1
    assert seeds.scale_m.tolist() == [pytest.approx([0.00745356] * 3, abs=1e-8)]
    assert seeds.scale_m.log()[0, 0].item() == pytest.approx(-4.899064, abs=1e-5)
    assert seeds.xyz_W.tolist() == [[0.0, 0.0, 2.0]]
    assert seeds.opacity.tolist() == [0.5]
    assert seeds.quat.tolist() == [[1.0, 0.0, 0.0, 0.0]]
    assert seeds.tag.tolist() == [0]


def test_the_disc_of_a_cell_lies_in_the_surface():
    """A wall that is turned by 45 degrees about y: z = 2 + x. Its normal is (1, 0, -1) / sqrt 2.
    The cell of 16 x 12 pixels covers (16 / sqrt 2) / 600 / cos 45 = 1.6 d along the wall, of which
    1.5 d are allowed, and (12 / sqrt 2) / 500 = 1.018 d across."""
    j, i = torch.meshgrid(torch.arange(12.0), torch.arange(16.0), indexing="ij")
    ray_x = (i + 0.5 - 8) / 600
    tilted = frame(2 / (1 - ray_x) + 0 * j, torch.zeros(12, 16, 3))
    ctx = SeedContext(tilted)
    seeds = ctx.cells()
    round_ones = ctx.cells(thickness=1.0, opacity=0.5)
    assert len(seeds) == 1
    axes = quaternion.to_matrix(seeds.quat)[0]
    normal = torch.tensor([1.0, 0.0, -1.0]) / 2**0.5
    assert abs(float(axes[:, 2] @ normal)) == pytest.approx(1, abs=1e-4)
    d = round_ones.scale_m[0, 0].item()
    assert seeds.scale_m.tolist() == [pytest.approx([1.5 * d, 1.018234 * d, 0.2 * d], rel=1e-4)]
    assert seeds.opacity.tolist() == [pytest.approx(0.9)]
    assert torch.equal(seeds.xyz_W, round_ones.xyz_W)


def cells_around_the_middle(*levels: int, width: int = 12, height: int = 12) -> Cells:
    """Cells of this size, one of each level, in the middle of an image of 64 x 48 pixels."""
    n = torch.ones(len(levels), dtype=torch.int32)
    return Cells(
        x0=(32 - width // 2) * n,
        y0=(24 - height // 2) * n,
        width=width * n,
        height=height * n,
        level=torch.tensor(levels, dtype=torch.int32),
    )


@pytest.mark.parametrize(("lean_deg", "stretch"), [(40, 1 / 0.766044), (60, 1.5)])
def test_a_large_disc_covers_its_cell_in_the_picture(lean_deg, stretch):
    """Seen along its lean, 1 / cos(lean) cancels the foreshortening, up to 1.5 times. A small disc
    stays as it is, and one that faces the camera as large as it is."""
    lean = torch.deg2rad(torch.tensor(float(lean_deg)))
    leaning = torch.tensor([torch.sin(lean), 0.0, -torch.cos(lean)])
    facing = torch.tensor([0.0, 0.0, -1.0])
    ctx = SeedContext(frame(torch.full((48, 64), 2.0), fx=500.0))
    size_m = 2 * 72**0.5 / 500
    seeds = Seeds.isotropic(
        torch.tensor([[0.0, 0.0, 2.0]]).expand(4, 3), torch.zeros(4, 3), torch.full((4,), size_m)
    )
    discs = as_discs(ctx, seeds, torch.stack([leaning, facing, leaning, leaning]), 0.2)
    made = over_cells(ctx, discs, cells_around_the_middle(3, 3, 4, 5))
    for name in ("quat", "scale_m"):
        assert torch.equal(getattr(made, name)[2:], getattr(discs, name)[2:])
    expected = size_m * torch.tensor([[stretch, 1.0, 0.2], [1.0, 1.0, 0.2]])
    torch.testing.assert_close(made.scale_m[:2], expected)
    axes = quaternion.to_matrix(made.quat[:2])
    torch.testing.assert_close(axes[:, :, 2], torch.stack([leaning, facing]), atol=1e-6, rtol=0)
    along = torch.tensor([torch.cos(lean), 0.0, torch.sin(lean)])
    assert abs(float(axes[0, :, 0] @ along)) == pytest.approx(1, abs=1e-6)


def test_the_footprint_of_a_cell_is_the_cell_again_in_the_picture():
    """A flat Gaussian with the standard deviations of the footprint, on a plane that leans, off the
    middle of the picture, seen by a turned camera: projected, it has the variances w^2 / 2 and h^2
    / 2 of the cell of 12 x 6 pixels, and the 0.3 of the renderer."""
    T_WC = se3.exp(torch.tensor([0.3, -0.2, 0.1, 0.4, -0.3, 0.5]))
    view = frame(torch.full((48, 64), 2.0), T_WC=T_WC)
    cells = dataclasses.replace(
        cells_around_the_middle(2, width=12, height=6),
        x0=torch.tensor([40], dtype=torch.int32),
        y0=torch.tensor([4], dtype=torch.int32),
    )
    x = (cells.centre_uv[0, 0] - 32) / 600
    y = (cells.centre_uv[0, 1] - 24) / 500
    xyz_W = se3.apply(T_WC, 2 * torch.stack([x, y, torch.tensor(1.0)]))[None]
    normal_C = torch.nn.functional.normalize(torch.tensor([[0.5, -0.7, -0.9]]), dim=1)
    normal_W = se3.rotate(T_WC, normal_C)
    longest, size_m = cell_on_plane(SeedContext(view), xyz_W, normal_W, cells)
    assert float((longest * normal_W).sum()) == pytest.approx(0, abs=1e-6)
    assert size_m[0, 0] > size_m[0, 1]
    axes = torch.stack([longest, torch.linalg.cross(normal_W, longest), normal_W], dim=-1)
    model = GaussianModel(sh_degree=0)
    disc = Seeds.isotropic(xyz_W, torch.zeros(1, 3), torch.tensor([0.1]))
    scale_m = torch.cat([size_m, torch.full((1, 1), 1e-6)], dim=1)
    model.append(dataclasses.replace(disc, quat=quaternion.from_matrix(axes), scale_m=scale_m))
    a, b, c = project_gaussians(model.params, view.camera, T_WC).conic[0].double().tolist()
    cov = torch.tensor([[a, b], [b, c]]).inverse()
    torch.testing.assert_close(cov, torch.tensor([[72.3, 0.0], [0.0, 18.3]]), atol=0.02, rtol=1e-3)


def test_discs_do_not_depend_on_the_size_of_the_picture():
    """The same tilted wall at 32 x 24 and 64 x 48 pixels."""

    def seeds(factor: int) -> Seeds:
        j, i = torch.meshgrid(
            torch.arange(24.0 * factor), torch.arange(32.0 * factor), indexing="ij"
        )
        ray_x = (i + 0.5 - 16 * factor) / (30 * factor)
        wall = Frame(
            index=0,
            timestamp_s=0.0,
            rgb=torch.full((24 * factor, 32 * factor, 3), 0.5),
            depth_m=2 / (1 - 0.4 * ray_x) + 0 * j,
            camera=Camera(
                width=32 * factor,
                height=24 * factor,
                fx=30.0 * factor,
                fy=30.0 * factor,
                cx=16.0 * factor,
                cy=12.0 * factor,
            ),
            T_WC=torch.eye(4),
        )
        return SeedContext(wall).cells(largest_m=0.25)

    small = seeds(1)
    large = seeds(2)
    assert small.tag.tolist() == large.tag.tolist()
    assert set(small.tag.tolist()) == {3}
    # the middle of a cell is the corner of a pixel, and its depth that of the pixel's own middle
    torch.testing.assert_close(large.scale_m, small.scale_m, rtol=0.03, atol=0)
    assert float((small.scale_m[:, 0] / small.scale_m[:, 1] - 1).abs().max()) > 0.1


def test_a_plain_wall_is_cut_by_its_depth():
    """32 x 16 pixels at 2 m, fx 600: 2 r / 600 = 0.060 for the whole, 0.030 and 0.015 for a half
    and a quarter; the nearer half of a step is cut less."""
    wall = frame(torch.full((16, 32), 2.0), torch.zeros(16, 32, 3))
    ctx = SeedContext(wall)
    assert len(ctx.cells()) == 1
    assert len(ctx.cells(largest_m=0.06)) == 1
    assert len(ctx.cells(largest_m=0.059)) == 4
    assert len(ctx.cells(largest_m=0.0298)) == 16
    depth_m = wall.depth_m.clone()
    depth_m[:, 16:] = 1.0
    step = SeedContext(dataclasses.replace(wall, depth_m=depth_m))
    assert len(step.cells(largest_m=0.0298)) == 2 * 4 + 2  # the cut of the whole is by its middle


def test_depth_and_colour_come_from_the_pixel_that_contains_the_middle():
    # one leaf, 3 x 2, middle (1.5, 1.0): column 1, row 1
    depth = torch.arange(1.0, 7.0).reshape(2, 3)
    rgb = torch.arange(18.0).reshape(2, 3, 3) / 20
    seeds = SeedContext(frame(depth, rgb)).cells()
    assert seeds.xyz_W[0, 2].item() == 5.0
    assert torch.equal(seeds.rgb[0], rgb[1, 1])


def test_cells_without_depth_or_too_near_are_dropped():
    rgb = torch.zeros(4, 4, 3)
    rgb[:2, :2] = 1.0  # cut once; middles at pixels (1, 1), (1, 3), (3, 1), (3, 3) as (u, v)
    depth = torch.full((4, 4), 2.0)
    depth[3, 1] = 0.0
    depth[1, 3] = 0.39
    config = SeedingConfig(quadtree_contrast="std")
    ctx = SeedContext(frame(depth, rgb), config=config)
    uv = project(ctx.camera, ctx.cells().xyz_W)
    torch.testing.assert_close(uv, torch.tensor([[1.0, 1.0], [3.0, 3.0]]))
    assert len(SeedContext(frame(depth, rgb), config=config, near_m=0.0).cells()) == 3
    assert len(SeedContext(frame(depth, rgb), FakeVolume(), config=config).cells()) == 2


def test_seeds_are_placed_in_the_world():
    T_WC = se3.exp(torch.tensor([0.1, 0.2, 0.3, 0.5, -0.4, 0.3]))
    ctx = SeedContext(frame(torch.full((6, 8), 1.5), T_WC=T_WC))
    uv = torch.tensor([[0.2, 0.4], [7.9, 5.9]])
    seeds = ctx.seeds_at(
        uv,
        torch.tensor([1.0, 2.0]),
        opacity=0.7,
        tag=torch.tensor([4, 5]),
    )
    xyz_C = se3.apply(se3.inverse(T_WC), seeds.xyz_W)
    torch.testing.assert_close(
        project(ctx.camera, xyz_C),
        uv,
        atol=1e-3,
        rtol=0,
    )
    torch.testing.assert_close(xyz_C[:, 2], torch.tensor([1.5, 1.5]))
    torch.testing.assert_close(seeds.scale_m[:, 0], torch.tensor([1.5, 3.0]) / 600)
    assert seeds.tag.tolist() == [4, 5]
    assert seeds.opacity.tolist() == pytest.approx([0.7, 0.7])


def test_map_view_of_a_gaussian_map():
    model = GaussianModel(sh_degree=0)
    scale_m = torch.tensor([[0.01, 0.03, 0.05], [0.02, 0.02, 0.02]])
    xyz = torch.tensor([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]])
    round_ones = Seeds.isotropic(
        xyz,
        xyz / 10,
        scale_m[:, 0],
        opacity=0.25,
        tag=torch.tensor([7, 8]),
    )
    model.append(dataclasses.replace(round_ones, scale_m=scale_m))
    view = SeedContext(frame(torch.ones(2, 2)), gaussians=model).map
    assert len(view) == 2
    torch.testing.assert_close(view.xyz_W, xyz)
    torch.testing.assert_close(view.radius_m, torch.tensor([0.04, 0.02]))
    torch.testing.assert_close(view.opacity, torch.tensor([0.25, 0.25]))
    assert view.tag is not None
    assert view.tag.tolist() == [7, 8]
    assert view.state is None
    assert len(SeedContext(frame(torch.ones(2, 2)), gaussians=GaussianModel()).map) == 0


def test_render_shows_the_map_where_it_is():
    ctx = check_contexts()["half seen"]
    out = ctx.render()
    assert ctx.render() is out
    W = ctx.camera.width
    assert out.alpha[:, : W // 4].mean() > 10 * out.alpha[:, 3 * W // 4 :].mean()
    assert out.first_index is not None
    assert 0 <= out.first_index.max() < len(ctx.map)
    assert float(check_contexts()["new"].render().alpha.max()) == 0.0


def test_normals_face_the_camera_and_turn_with_the_pose():
    T_WC = se3.exp(torch.tensor([0.0, 0.0, 0.0, 0.0, math.pi / 2, 0.0]))
    ctx = SeedContext(frame(torch.full((5, 5), 1.0), T_WC=T_WC))
    torch.testing.assert_close(
        ctx.normals()[2, 2],
        torch.tensor([0.0, 0.0, -1.0]),
    )
    torch.testing.assert_close(
        ctx.normals_W()[2, 2],
        torch.tensor([-1.0, 0.0, 0.0]),
        atol=1e-6,
        rtol=0,
    )
    assert ctx.normals() is ctx.normals()


def test_volume_lookups():
    ctx = SeedContext(frame(torch.ones(2, 2)), FakeVolume())
    xyz = torch.tensor([[0.1, 0.6, -0.1], [1.6, -0.6, 0.0]])
    assert ctx.voxel_weight(xyz).tolist() == [0.0, 3.0]
    assert ctx.tsdf(xyz).tolist() == pytest.approx([0.0, 0.3])
    assert voxel_index(ctx, xyz).tolist() == [[0, 1, -1], [3, -2, 0]]
    assert voxel_index(ctx, xyz).dtype == torch.int64
    assert ctx.near_m == 0.7
