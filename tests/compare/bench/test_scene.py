import pytest
import torch

from gsfusion_nb.compare.bench import random_scene
from gsfusion_nb.constants import ALPHA_MIN
from gsfusion_nb.geometry import project, se3
from gsfusion_nb.render import project_gaussians, render


def test_the_same_seed_gives_the_same_scene():
    a, b, other = (random_scene(50, 64, 48, sh_degree=1, seed=s) for s in (3, 3, 4))
    assert all(torch.equal(x, y) for x, y in zip(vars(a.params).values(), vars(b.params).values(), strict=True))
    assert torch.equal(a.v_rgb, b.v_rgb)
    assert not torch.equal(a.params.xyz_W, other.params.xyz_W)


def test_centres_fill_the_frustum_and_a_border():
    scene = random_scene(5000, 320, 240)
    xyz_C = se3.apply(se3.inverse(scene.T_WC), scene.params.xyz_W)
    z, uv = xyz_C[:, 2], project(scene.camera, xyz_C) / torch.tensor([320.0, 240.0])
    assert 1.99 < float(z.min()) < 2.05
    assert 5.95 < float(z.max()) < 6.01
    assert float(uv.min()) == pytest.approx(-0.05, abs=0.005)
    assert float(uv.max()) == pytest.approx(1.05, abs=0.005)
    assert scene.params.opacity_logit.sigmoid().aminmax() == pytest.approx((0.1, 0.95), abs=0.01)


@pytest.mark.parametrize(("n", "size"), [(1000, (160, 120)), (5000, (160, 120)), (5000, (320, 240))])
def test_about_thirty_gaussians_are_visible_at_a_pixel(n, size):
    """Counted by brute force at a few hundred pixels, from the projection alone."""
    scene = random_scene(n, *size)
    p = project_gaussians(scene.params, scene.camera, scene.T_WC)
    g = torch.Generator().manual_seed(1)
    uv = torch.rand(300, 1, 2, generator=g) * torch.tensor(size, dtype=torch.float32)
    dx, dy = (uv - p.uv).unbind(-1)
    A, B, C = p.conic.unbind(-1)
    alpha = p.opacity * torch.exp(-0.5 * (A * dx**2 + C * dy**2) - B * dx * dy)
    assert float((alpha >= ALPHA_MIN).sum(1).float().mean()) == pytest.approx(30, rel=0.25)


def test_degrees_and_an_empty_scene():
    assert random_scene(10, 64, 48, sh_degree=3).params.sh.shape == (10, 16, 3)
    empty = random_scene(0, 64, 48)
    assert float(render(empty.params, empty.camera, empty.T_WC).alpha.max()) == 0
