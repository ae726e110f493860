"""What the function of every exercise becomes in the library, or why it becomes nothing; and the smaller pieces."""

import pytest
import torch

from gsfusion_nb import GSFusion, backends, gsfusion
from gsfusion_nb.backends import replaceable, use_backend
from gsfusion_nb.course import becomes, check, exercises, mine
from gsfusion_nb.course.mine import LearnerError
from gsfusion_nb.course.whose import yours_with_reference
from gsfusion_nb.mapping.gsfusion import plan_frame
from gsfusion_nb.optim.keyframes import draw_keyframes
from gsfusion_nb.seeding.quadtree import cell_gaussians, quadtree
from gsfusion_nb.seeding.rules.gsfusion import first_seen
from gsfusion_nb.tsdf.marching_cubes import zero_crossing
from gsfusion_nb.tsdf.morton import OFFSET, interleave
from gsfusion_nb.tsdf.volume import block_of
from gsfusion_nb.types import Camera, Frame

RUNS_AS = {
    "first_seen": "first_seen",
    "block_of": "block_of", "morton_code": "interleave", "running_average": "tsdf_update",
    "signed_distance": "signed_distance_m", "zero_crossing": "zero_crossing",
    "cell_to_gaussian": "cell_gaussians", "contrast": "luma_variance", "quadtree_leaves": "quadtree",
    "split_cell": "cut",
    "composite_pixel": "blend", "project_gaussian": "project_gaussians", "splat_alpha": "splat_alpha",
    "tiles_touched": "tile_intersections", "view_colour": "sh_to_rgb",
    "adam": "adam_update", "blend_vjp": "blend_vjp", "l1_gradient": "l1_vjp",
    "project_gaussian_vjp": "project_gaussians_vjp", "splat_alpha_vjp": "splat_alpha_vjp",
    "draw_keyframes": "draw_keyframes", "plan_frame": "plan_frame",
    "adding_masks": "adding_masks", "disc_hit": "disc_hit", "fuse": "fuse", "next_state": "next_states",
    "gauss_newton": "next_pose", "graph_step": "pose_graph_step", "point_to_plane": "point_to_plane",
    "predict": "constant_velocity", "relative_error": "relative_pose_error",
    "blend_over": "blend_with_base", "blend_over_vjp": "blend_with_base_vjp", "weights_over": "not_behind",
}  # fmt: skip
"""Exercise -> operation or piece of the library that its function becomes under the backend ``mine``."""

STAND_ALONE = {
    "exam_frames", "psnr",
    "halve_intrinsics", "invert_pose", "lift_pixels", "normals_of_points", "project_points",
    "covariance_2d", "inverse_vjp", "pinhole_vjp", "slope", "frame_rate", "map_frame", "spread_correction",
    "budget_cells", "pareto_rules", "raster_rule", "silhouette_rule",
    "adam_traffic", "attainable_gflops", "average_loop", "overall_speedup",
    "depth_factor", "pose_shift", "tell_apart",
}  # fmt: skip
"""Exercises whose function runs nowhere in the library; each says why in ``stands_alone``."""


@pytest.fixture(autouse=True)
def nothing_kept(monkeypatch):
    for kept in (backends.FUNCTIONS, becomes.KEPT):
        for name in list(kept):
            monkeypatch.delitem(kept, name)
    mine.clear_counts()
    yield
    mine.forget()
    mine.clear_counts()


def test_every_exercise_becomes_a_piece_of_the_library_or_says_why_not():
    known = exercises()
    assert {name: e.becomes.operation for name, e in known.items() if e.becomes is not None} == RUNS_AS
    assert {name for name, e in known.items() if e.stands_alone} == STAND_ALONE
    assert RUNS_AS.keys() | STAND_ALONE == known.keys()
    assert not RUNS_AS.keys() & STAND_ALONE
    assert set(RUNS_AS.values()) <= replaceable()
    assert all(known[name].stands_alone.endswith(".") for name in STAND_ALONE)


def both(exercise, piece, *args):
    """What the reference gives, and what the exercise's solution gives in its place."""
    mine.keep(exercise, check.__getattr__(exercise)._solution)
    expected = piece(*args)
    with use_backend("mine"):
        got = piece(*args)
    assert backends.CALLS[RUNS_AS[exercise]].own == 1
    return expected, got


def test_pieces_of_the_volume(generator):
    p0 = torch.randn(9, 3, generator=generator, dtype=torch.float64)
    D0 = torch.rand(9, generator=generator) + 0.1
    expected, got = both("zero_crossing", zero_crossing, p0, p0 + 1.0, D0, -D0.flip(0))
    torch.testing.assert_close(got, expected)
    ijk = torch.randint(-40, 40, (3, 5, 3), generator=generator)
    assert torch.equal(*both("block_of", block_of, ijk))
    coords = torch.randint(-OFFSET, OFFSET, (20, 3), generator=generator)
    assert torch.equal(*both("morton_code", interleave, coords))


def test_the_gaussian_of_a_cell_and_whether_it_is_new(generator):
    camera = Camera(width=40, height=30, fx=20.0, fy=21.0, cx=20.0, cy=15.0)
    cells = quadtree(torch.randint(0, 256, (30, 40, 3), generator=generator, dtype=torch.uint8), threshold=1e-3)
    depth_m = 1 + torch.rand(30, 40, generator=generator)
    for expected, got in zip(*both("cell_to_gaussian", cell_gaussians, camera, cells, depth_m, torch.eye(4)),
                             strict=True):  # fmt: skip
        torch.testing.assert_close(got, expected)
    weight = torch.tensor([0.0, 1.0, 2.0])
    assert torch.equal(*both("first_seen", first_seen, weight, 1.0))


def test_a_cell_that_changes_the_depth_image_for_the_next_one_is_refused():
    mine.keep("cell_to_gaussian", lambda camera, cell, depth_m, T_WC: (depth_m.zero_()[0, :3], depth_m[0, 0]))
    camera = Camera(width=4, height=3, fx=4.0, fy=4.0, cx=2.0, cy=1.5)
    cells, depth_m = quadtree(torch.zeros(3, 4, 3, dtype=torch.uint8)), torch.ones(3, 4)
    with use_backend("mine"), pytest.raises(LearnerError, match="changed the depth image that was passed in"):
        cell_gaussians(camera, cells, depth_m, torch.eye(4))
    assert torch.equal(depth_m, torch.ones(3, 4))


def test_keyframes():
    expected, got = both("draw_keyframes", draw_keyframes, 5, 2, torch.Generator().manual_seed(1))
    assert len(expected) == len(got.unique()) == 2
    mine.keep("plan_frame", check.plan_frame._solution)
    for n_seeds, n_keyframes in ((60, 3), (50, 1), (3, 7)):
        expected = plan_frame(n_seeds, n_keyframes, 5, 3, 2, 50)
        with use_backend("mine"):
            assert plan_frame(n_seeds, n_keyframes, 5, 3, 2, 50) == expected
    mine.keep("draw_keyframes", lambda n, count, generator: [0, 0])
    with (
        use_backend("mine"),
        pytest.raises(LearnerError, match=r"must return 2 different numbers; it returned \[0, 0\]"),
    ):
        draw_keyframes(5, 2, torch.Generator())


def test_inputs_that_a_failing_function_changed_are_as_before(capsys):
    def contrast(cell_rgb, image_pixels):
        cell_rgb.zero_()
        if image_pixels == 7:
            raise ValueError("seven")
        return 0.0

    works = yours_with_reference("contrast", contrast, check.contrast._solution)
    cell = torch.randint(0, 256, (4, 4, 3), dtype=torch.uint8, generator=torch.Generator().manual_seed(0))
    before = cell.clone()
    assert works(cell, 7) == check.contrast._solution(before, 7)
    assert torch.equal(cell, before)
    assert "it had changed its inputs before, which is taken back" in capsys.readouterr().out


def test_a_frame_in_which_the_learners_function_fails_is_taken_back():
    camera = Camera(width=16, height=12, fx=14.0, fy=14.0, cx=8.0, cy=6.0)
    rgb = torch.rand(12, 16, 3, generator=torch.Generator().manual_seed(3))
    frame = Frame(index=0, timestamp_s=0.0, rgb=rgb, depth_m=torch.full((12, 16), 2.0), camera=camera,
                  T_WC=torch.eye(4))  # fmt: skip
    config = gsfusion("online", sh_degree=0, tsdf__voxel_size_m=0.2, seeding__quadtree_contrast="std",
                      optim__keyframe_iterations=2)  # fmt: skip
    mapper, calls = GSFusion(config), []

    def l1_gradient(rgb, target):
        calls.append(1)
        if len(calls) == 2:
            raise ValueError("the second step")
        return torch.sign(rgb - target) / rgb.numel()

    mine.keep("l1_gradient", l1_gradient)
    with use_backend("mine"):
        with pytest.raises(LearnerError, match=r"your l1_gradient .* raised ValueError: the second step"):
            mapper.step(frame)
        assert (len(mapper.gaussians), len(mapper.keyframes), mapper.volume.n_blocks) == (0, 0, 0)
        assert mapper.step(frame).n_seeds == len(mapper.gaussians) > 0
