"""Chapter 7's solutions against the library: what the student writes is what the mapper does."""

import pytest
import torch

from gsfusion_nb.config import StateConfig
from gsfusion_nb.course import exercises
from gsfusion_nb.gaussians import SurfelModel, change_states
from gsfusion_nb.gaussians.surfels import STABLE
from gsfusion_nb.geometry import pixel_grid, rays
from gsfusion_nb.optim import fuse_with_history
from gsfusion_nb.render import disc_depth
from gsfusion_nb.types import Camera, GaussianParams, Seeds

CAMERA = Camera(width=16, height=12, fx=14.0, fy=14.0, cx=8.0, cy=6.0)
SOLUTIONS = {name: e._solution for name, e in exercises().items() if e.chapter == 7}


def test_chapter_7_has_four():
    assert set(SOLUTIONS) == {"disc_hit", "adding_masks", "next_state", "fuse"}


@pytest.mark.parametrize("quat", [(1.0, 0.0, 0.0, 0.0), (0.9, 0.3, 0.2, 0.1), (0.75, 0.0, 0.66, 0.0)])
def test_disc_hit_is_the_librarys_depth(quat):
    q = torch.tensor([quat])
    params = GaussianParams(
        xyz_W=torch.tensor([[0.1, -0.05, 2.0]]), log_scale=torch.tensor([[-1.0, -1.0, -4.0]]), quat=q / q.norm(),
        opacity_logit=torch.tensor([4.0]), sh=torch.zeros(1, 1, 3),
    )  # fmt: skip
    model = SurfelModel(sh_degree=0)
    model.append(
        Seeds(xyz_W=params.xyz_W, rgb=torch.ones(1, 3), scale_m=params.log_scale.exp(), quat=params.quat,
              opacity=torch.tensor([0.99]), tag=torch.tensor([1], dtype=torch.int32))
    )  # fmt: skip
    hit = torch.zeros(12, 16, dtype=torch.int32)
    library = disc_depth(params, CAMERA, torch.eye(4), hit, max_offset=None, min_cosine=0.5).depth_m
    grid = rays(CAMERA, pixel_grid(CAMERA))
    for v, u in ((0, 0), (6, 8), (11, 3)):
        mine = SOLUTIONS["disc_hit"](grid[v, u], params.xyz_W[0], model.normal_W[0])
        assert float(mine) == pytest.approx(float(library[v, u]), rel=1e-4)


@pytest.mark.parametrize("stable", [False, True])
@pytest.mark.parametrize(
    ("eta", "errors", "age"), [(0, 0, 1), (101, 0, 1), (100, 0, 130), (400, 11, 130), (400, 10, 5)]
)
def test_next_state_is_what_change_states_does(stable, eta, errors, age):
    model = SurfelModel(sh_degree=0)
    model.append(Seeds.isotropic(torch.zeros(1, 3), torch.ones(1, 3), torch.tensor([0.1]), opacity=0.99))
    model.state[0], model.confidence[0] = STABLE if stable else 0, eta
    model.colour_errors[0], model.step_count = errors, age
    change_states(model, StateConfig(max_radius_factor=None))
    said = SOLUTIONS["next_state"](stable, eta, errors if stable else 0, age)
    happened = "is deleted" if not len(model) else {0: "unstable", 1: "stable"}[int(model.state[0])]
    expected = {
        "stays": "stable" if stable else "unstable", "becomes stable": "stable", "becomes unstable": "unstable",
        "is deleted": "is deleted",
    }  # fmt: skip
    assert happened == expected[said]


def test_fuse_is_the_librarys_fusion_of_centres(generator):
    before, after = (torch.randn(6, 3, generator=generator) for _ in range(2))
    eta, more = torch.tensor([0, 5, 10, 50, 7, 0]), torch.tensor([20, 5, 40, 60, 7, 0])

    def params(xyz):
        unit = torch.tensor([1.0, 0.0, 0.0, 0.0]).expand(6, 4).clone()
        return GaussianParams(
            xyz_W=xyz, log_scale=torch.zeros(6, 3), quat=unit, opacity_logit=torch.zeros(6), sh=torch.zeros(6, 1, 3)
        )

    library = fuse_with_history(params(before), params(after), eta, more).xyz_W
    seen = more > 0
    assert torch.allclose(SOLUTIONS["fuse"](before, after, eta, more)[seen], library[seen], atol=1e-6)
