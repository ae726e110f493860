"""Raycast of the volumetric map."""

# pyright: reportFunctionMemberAccess=false

import pytest
import torch

from gsfusion_nb.backends import use_backend
from gsfusion_nb.config import TsdfConfig
from gsfusion_nb.tsdf import TsdfVolume, raycast

CONFIG = TsdfConfig(voxel_size_m=0.08, truncation_voxels=3.0, max_weight=3.0)


@pytest.fixture
def mapped(make_frames, make_volume):
    frames = make_frames(40, 30, n=2)
    return make_volume(CONFIG, frames), frames


@pytest.mark.parametrize(("width", "height"), [(20, 15), (17, 1), (1, 1)])
def test_same_picture(width, height, mapped, to, compare, copy_to):
    volume, frames = mapped
    camera, ours = frames[0].camera.resized(width, height), copy_to(volume)
    for frame in frames[:1]:
        expected = raycast.reference(volume, camera, frame.T_WC)
        with use_backend("cuda"):
            found = raycast(ours, camera, to(frame.T_WC))
        for name, tolerance in (("depth_m", 1e-5), ("normal_W", 1e-3), ("rgb", 1e-3)):
            compare("raycast", name, getattr(found, name), getattr(expected, name), tolerance, share=1e-2)
    assert height < 15 or float((found.depth_m > 0).double().mean()) > 0.2


def test_raycast_from_inside_and_of_nothing(mapped, device, compare, copy_to):
    volume, frames = mapped
    camera = frames[0].camera.resized(16, 12)
    volume.W[::3] = 0.0
    expected = raycast.reference(volume, camera, torch.eye(4))
    with use_backend("cuda"):
        found = raycast(copy_to(volume), camera, torch.eye(4))
        empty = raycast(TsdfVolume(CONFIG, device), camera, torch.eye(4))
    compare("raycast", "depth_m", found.depth_m, expected.depth_m, 1e-5, share=1e-2)
    assert not bool(empty.depth_m.any())
