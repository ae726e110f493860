"""What is mapped is drawn: the near plane follows the nearest depth that is mapped."""

import dataclasses
from typing import Any

import pytest
import torch

from gsfusion_nb.config import gps_slam, gsfusion, rtg_slam
from gsfusion_nb.evaluation import expected_depth_m, psnr
from gsfusion_nb.mapping import GPSSLAM, make_mapper
from gsfusion_nb.mapping.gps_slam import over_surface
from gsfusion_nb.render.constants import NEAR_PLANE_M
from gsfusion_nb.render.near_plane import LEAST_PLANE_M, near_plane_m
from gsfusion_nb.types import Camera, Frame, GaussianParams
from gsfusion_nb.viz import SplatViewer

CAMERA = Camera(width=32, height=24, fx=30.0, fy=30.0, cx=16.0, cy=12.0)
TSDF: dict[str, Any] = {
    "tsdf__near_m": 0.1,
    "tsdf__voxel_size_m": 0.01,
    "tsdf__truncation_voxels": 4.0,
}
SETTINGS = {
    "gsfusion": gsfusion("room", tracking__poses="given", seeding__quadtree_largest_m=0.01, **TSDF),
    "rtg_slam": rtg_slam("room", tracking__poses="given", data__depth_min_m=0.1),
}


def wall(index: int, distance_m: float) -> Frame:
    """A striped wall across the picture."""
    stripes = (torch.arange(CAMERA.width) // 4 % 2).float().expand(CAMERA.height, -1)
    return Frame(
        index=index,
        timestamp_s=float(index),
        rgb=torch.stack([stripes, 0.5 + 0 * stripes, 1 - stripes], dim=-1),
        depth_m=torch.full((CAMERA.height, CAMERA.width), distance_m),
        camera=CAMERA,
        T_WC=torch.eye(4),
    )


@pytest.mark.parametrize("nearest_m", [0.4, 0.2, 0.15, 0.0])
def test_the_plane_is_the_published_one_or_the_nearest_mapped_depth(nearest_m):
    expected_m = min(NEAR_PLANE_M, max(LEAST_PLANE_M, nearest_m))
    assert near_plane_m(gsfusion("room", tsdf__near_m=nearest_m)) == expected_m
    assert near_plane_m(gps_slam("room", tsdf__near_m=nearest_m)) == expected_m
    without_tsdf = near_plane_m(rtg_slam("room", data__depth_min_m=nearest_m))
    assert without_tsdf == (expected_m if nearest_m else NEAR_PLANE_M)


@pytest.mark.parametrize("system", SETTINGS)
def test_a_wall_nearer_than_the_published_plane_is_drawn_and_learnt(system):
    mapper = make_mapper(SETTINGS[system])
    for index in range(6):
        mapper.step(wall(index, 0.15))
    for _ in mapper.global_optimise():
        pass
    target = wall(0, 0.15)
    picture = mapper.render(CAMERA, target.T_WC)
    centres_m = mapper.gaussians.params.xyz_W[:, 2]
    assert len(centres_m) > 20
    assert (centres_m < NEAR_PLANE_M).float().mean() > 0.9
    assert picture.alpha.mean() > 0.9
    assert psnr(picture.rgb, target.rgb) > 14  # 4 dB if nothing is drawn
    assert (expected_depth_m(picture) - 0.15).abs().mean() < 0.03


def test_gps_slam_draws_near_gaussians_over_its_surface():
    mapper = GPSSLAM(gps_slam("room", tracking__poses="given", **TSDF))
    mapper.step(wall(0, 0.15))
    assert over_surface(mapper).near_m == 0.1
    near = GaussianParams(
        xyz_W=torch.tensor([[0.0, 0.0, 0.12]]),
        log_scale=torch.full((1, 3), 0.01).log(),
        quat=torch.tensor([[1.0, 0.0, 0.0, 0.0]]),
        opacity_logit=torch.tensor([3.0]),
        sh=torch.full((1, 1, 3), 1.5),
    )
    shown = dataclasses.replace(over_surface(mapper), params=near).render(CAMERA, torch.eye(4))
    bare = mapper.render(CAMERA, torch.eye(4))
    assert (shown.rgb - bare.rgb).abs().max() > 0.2


def test_a_viewer_turns_around_what_is_near():
    mapper = make_mapper(SETTINGS["gsfusion"])
    for index in range(3):
        mapper.step(wall(index, 0.15))
    viewer = SplatViewer(mapper)
    assert viewer.rules["near_m"] == 0.1
    assert viewer.pivot_m == pytest.approx(0.15, abs=0.03)
