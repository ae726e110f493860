"""Place, size and opacity of what every rule seeds, on a hand-made picture, by the formulas of the publications.

A wall 2 m away, seen straight on by 64 x 48 pixels with fx = 60 and fy = 50. So a pixel is 2/60 m wide and 2/50 m high,
and the three nearest neighbours of a pixel's point are two at 2/60 m and one at 2/50 m.
"""

import dataclasses
from dataclasses import dataclass, field
from math import sqrt
from typing import Any

import pytest
import torch

from gsfusion_nb.config import TsdfConfig
from gsfusion_nb.gaussians import GaussianModel
from gsfusion_nb.seeding import SeedContext, Seeds, apply_rule
from gsfusion_nb.seeding.image_features import absolute_laplacian, disc_blur, halved
from gsfusion_nb.tsdf import TsdfVolume, integrate
from gsfusion_nb.types import Camera, Frame

W, H, FX, FY, Z = 64, 48, 60.0, 50.0, 2.0
WIDTH, HEIGHT = 2 / 60, 2 / 50
D3 = sqrt((2 * WIDTH**2 + HEIGHT**2) / 3)
"""sqrt(nn2): root mean square distance to the 3 nearest of all pixels."""
SPLATAM = 2 / 55
"""z / ((fx + fy) / 2)."""


@dataclass(frozen=True, kw_only=True)
class Case:
    """What a rule must seed at one place of the picture."""

    sigma: tuple[float, float, float]
    opacity: float = 0.5
    options: dict[str, Any] = field(default_factory=dict)
    at: tuple[float, float] = (32.5, 24.5)
    z: float = Z
    picture: str = "grey"
    mapped: bool = False
    """Whether there is a map already, elsewhere, so that the frame shows nothing of it."""


def ball(sigma: float) -> tuple[float, float, float]:
    return (sigma, sigma, sigma)


def disc(sigma: float, thickness: float = 0.1) -> tuple[float, float, float]:
    return (sigma, sigma, thickness * sigma)


ALL = {"share": 1.0}
HALF_DIAGONAL_PX = 40.0  # sqrt(32^2 + 24^2): a plain picture is one leaf of the quadtree
STEP_P = 0.75 * 22 / 37  # B |Laplacian| 1.5 pixels left of a step (test_a_step_halved_and_enlarged)
CASES: dict[str, Case] = {
    "gsfusion": Case(sigma=ball(Z * HALF_DIAGONAL_PX / FX), at=(32.0, 24.0)),
    "vg_mapping": Case(  # n = 1 / (1 + (0, 0, 1)) = (1, 1, 1/2), |n| = 3/2
        sigma=disc(Z * HALF_DIAGONAL_PX / FX * 2 / 3, 0.5), at=(32.0, 24.0)
    ),
    "uniform": Case(sigma=ball(Z * sqrt(1 / (2 * 0.05)) / FX), options={"coverage": False}),
    "dense": Case(sigma=ball(Z / FX)),
    "splatam": Case(sigma=ball(SPLATAM)),
    "splatam_like": Case(sigma=ball(SPLATAM)),
    "mm3dgs": Case(sigma=ball(SPLATAM)),
    "hf_slam": Case(sigma=ball(SPLATAM)),
    "gaus_slam": Case(sigma=disc(SPLATAM)),
    "vtgaussian": Case(sigma=ball(1.005 * SPLATAM), z=1.005 * Z),
    "vtgaussian, fine": Case(sigma=ball(1.005 * SPLATAM / 2), at=(32.25, 24.25), z=1.005 * Z, picture="step"),
    "monogs": Case(sigma=ball(sqrt(0.05) * D3), options={"density": 32.0}),  # 1/32 in the first frame
    "monogs_like": Case(sigma=ball(sqrt(0.05) * D3), options={"density": 32.0}),
    "gaussian_slam": Case(sigma=ball(1.005 * D3), z=1.005 * Z),
    "gs_slam": Case(sigma=ball(D3), options={"first_share": 1.0}),
    "cg_slam": Case(sigma=ball(D3)),
    "game": Case(sigma=ball(sqrt(0.05) * D3), options=ALL),
    "photo_slam": Case(sigma=ball(10 * D3), opacity=0.1, picture="corners"),
    "gs_icp": Case(  # 3 x 3 points of a grid of 4 pixels: variance 2/3 of the distance squared; 2 z^1.5 = 5.657
        sigma=(1e-7**0.5, sqrt(2 / 3) * 4 * WIDTH / 5.656854, sqrt(2 / 3) * 4 * HEIGHT / 5.656854),
        opacity=0.1,
        options={"density": 6.25, "neighbours": 9},
    ),
    "rtg_slam": Case(sigma=disc(D3), opacity=0.99, options=ALL),
    "two_dgs_slam": Case(sigma=disc(D3), opacity=0.73087, options=ALL),  # sigmoid(0.999)
    "gps_slam": Case(sigma=disc(0.01), options=ALL | {"surface": "depth"}),
    "vings": Case(sigma=disc(D3), opacity=0.1, options=ALL),
    "vings, later": Case(sigma=disc(D3), opacity=0.8, options=ALL, mapped=True),
    "on_the_fly_nvs": Case(sigma=ball(Z / FX), opacity=0.07, picture="step", at=(31.5, 24.5)),  # P = 1.05: one pixel
    "on_the_fly_nvs, sparse": Case(
        sigma=ball(Z / FX / sqrt(2 * STEP_P)), opacity=0.07, picture="step", at=(30.5, 24.5)
    ),
    "edge_discs": Case(sigma=disc(0.7 * 4 * Z / FX, 0.2), opacity=0.9, at=(33.0, 22.784610)),
    "edge_strokes": Case(sigma=disc(0.7 * 4 * Z / FX, 0.2), opacity=0.9, at=(33.0, 22.784610)),
    "default_strategy": Case(sigma=ball(SPLATAM / sqrt(0.05))),
    "mcmc": Case(sigma=ball(SPLATAM / sqrt(0.05))),
    "cone_gs": Case(sigma=ball(D3), opacity=0.1, options=ALL),
    "cone_gs, later": Case(  # the diameter of a pixel's cone
        sigma=ball((WIDTH + HEIGHT) / 2), opacity=0.1, options={"share": 1e3}, mapped=True
    ),
}
"""Rule, with a word on the case where there are several -> what it seeds."""


@dataclass(frozen=True, eq=False, kw_only=True)
class WithCorners(SeedContext):
    """A context whose corners are every 10th pixel."""

    def corners(self, count: int = 1000, method: str = "orb") -> torch.Tensor:
        u, v = torch.meshgrid(torch.arange(2.5, W, 10), torch.arange(4.5, H, 10), indexing="xy")
        return torch.stack([u, v], dim=-1).reshape(-1, 2)


def context(case: Case) -> SeedContext:
    rgb = torch.full((H, W, 3), 0.5)
    if case.picture == "step":
        rgb = (torch.arange(W) >= W // 2).float()[None, :, None].expand(H, W, 3).contiguous()
    frame = Frame(
        index=0,
        timestamp_s=0.0,
        rgb=rgb,
        depth_m=torch.full((H, W), Z),
        camera=Camera(width=W, height=H, fx=FX, fy=FY, cx=W / 2, cy=H / 2),
        T_WC=torch.eye(4),
    )
    volume = TsdfVolume(TsdfConfig(voxel_size_m=0.05))
    integrate(volume, frame)
    model = GaussianModel(sh_degree=0)
    if case.mapped:
        behind = torch.tensor([[0.0, 0.0, -5.0]])
        model.append(Seeds.isotropic(behind, torch.full_like(behind, 0.5), torch.tensor([0.02])))
    kind = WithCorners if case.picture == "corners" else SeedContext
    return kind(frame, volume, model)


@pytest.mark.parametrize("name", CASES)
def test_place_size_and_opacity(name):
    case = CASES[name]
    ctx = context(case)
    seeds = apply_rule(name.partition(",")[0], ctx, case.options)
    z = seeds.xyz_W[:, 2]
    uv = torch.stack([seeds.xyz_W[:, 0] / z * FX + W / 2, seeds.xyz_W[:, 1] / z * FY + H / 2], dim=1)
    off = (uv - torch.tensor(case.at)).norm(dim=1)
    drawn = case.options.get("density", 1) <= 1 and name in ("uniform", "default_strategy", "mcmc")
    row = int(off.argmin())
    assert float(off[row]) < (5.0 if drawn else 1e-3)  # a rule that draws pixels may miss this one
    assert float(z[row]) == pytest.approx(case.z, rel=1e-6)
    assert sorted(seeds.scale_m[row].tolist()) == pytest.approx(sorted(case.sigma), rel=1e-4)
    assert float(seeds.opacity[row]) == pytest.approx(case.opacity, abs=1e-5)


def test_a_step_halved_and_enlarged():
    """Means of 2 x 2 pixels keep the step; between them, at 1/4 and 3/4, the picture is 0.25 and 0.75. So the absolute
    Laplacian is 0.25 in each of three channels at the four pixels around the step. Of the 37 pixels of the disc around
    the third pixel left of it, 7 + 7 + 5 + 3 are among these."""
    ctx = context(CASES["on_the_fly_nvs"])
    soft = halved(ctx.frame.rgb)
    assert soft[24, 29:35, 0].tolist() == pytest.approx([0.0, 0.0, 0.25, 0.75, 1.0, 1.0])
    laplacian = absolute_laplacian(soft)
    assert laplacian[24, 29:35].tolist() == pytest.approx([0.0, 0.75, 0.75, 0.75, 0.75, 0.0])
    assert float(disc_blur(laplacian, 3.5)[24, 30]) == pytest.approx(STEP_P)


def test_a_fine_gaussian_comes_besides_the_coarse_one():
    ctx = context(CASES["vtgaussian, fine"])
    seeds = apply_rule("vtgaussian", ctx)
    edges = int(ctx.edges(50.0, 200.0, 3, euclidean=True).sum())
    assert edges > 0
    assert len(seeds) == W * H + 4 * edges
    assert len(apply_rule("vtgaussian", ctx, {"fine": False})) == W * H


def test_the_euclidean_gradient_is_the_shorter_one():
    """A diagonal step of 30 grey levels: |gx| + |gy| is above OpenCV's 100, the root of the squares is not."""
    step = (torch.arange(W)[None] + torch.arange(H)[:, None] >= 55).float()[..., None].expand(H, W, 3)
    ctx = context(CASES["dense"])
    ctx = SeedContext(dataclasses.replace(ctx.frame, rgb=0.3 + step * 18 / 255))
    assert ctx.edges(100.0, 100.0).any()
    assert not ctx.edges(100.0, 100.0, euclidean=True).any()
