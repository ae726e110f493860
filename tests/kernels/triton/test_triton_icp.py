"""Normal equations of ICP."""

# pyright: reportFunctionMemberAccess=false

import pytest
import torch

from gsfusion_nb.backends import use_backend
from gsfusion_nb.geometry import depth_to_normals, se3
from gsfusion_nb.tracking import DepthLevel, Surface, icp_system

MOTION = se3.exp(torch.tensor([0.01, 0.02, -0.01, 0.01, -0.015, 0.02]).double())


@pytest.mark.parametrize("even_to_m", [None, 1.0])
@pytest.mark.parametrize(("width", "height"), [(1, 1), (7, 5), (40, 31)])
def test_same_sums(make_frames, width, height, even_to_m, to, compare):
    exact = []
    for frame in make_frames(width, height):
        camera = frame.camera.resized(max(1, width * 3 // 2), height)
        normal_C = depth_to_normals(frame.camera, frame.depth_m)
        level = DepthLevel(factor=1, camera=frame.camera, depth_m=frame.depth_m, normal_C=normal_C)
        depth_m = torch.nn.functional.interpolate(frame.depth_m[None, None], (camera.height, camera.width))[0, 0]
        normal_W = se3.rotate(frame.T_WC, depth_to_normals(camera, depth_m))
        surface = Surface(depth_m=depth_m, normal_W=normal_W, camera=camera, T_WC=frame.T_WC)
        pose = MOTION @ frame.T_WC.double()
        for gates in ({"max_distance_m": 0.1, "min_cosine": 0.5}, {"max_distance_m": 10.0, "min_cosine": -1.1}):
            expected = icp_system.reference(level, pose, surface, **gates, even_to_m=even_to_m)
            with use_backend("triton"):
                found = icp_system(to(level), to(pose), to(surface), **gates, even_to_m=even_to_m)
            slack = max(2, 2e-3 * expected.n_overlap)
            assert abs(expected.n_inliers - found.n_inliers) <= slack
            assert abs(expected.n_overlap - found.n_overlap) <= slack
            exact.append((expected.n_inliers, expected.n_overlap) == (found.n_inliers, found.n_overlap))
            if exact[-1]:
                assert torch.equal(found.H, found.H.T)
                compare("icp_system", "H", found.H, expected.H, 1e-5)
                compare("icp_system", "b", found.b, expected.b, 2e-5)
                assert found.sum_squares_m2 == pytest.approx(expected.sum_squares_m2, rel=1e-4, abs=1e-12)
                assert found.sum_weights == pytest.approx(expected.sum_weights, rel=1e-5)
    assert any(exact)
