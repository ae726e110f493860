"""Normal equations of ICP on the CPU kernels against the reference."""

import pytest
import torch

from gsfusion_nb.backends import use_backend
from gsfusion_nb.geometry import depth_to_normals, se3
from gsfusion_nb.tracking import DepthLevel, Surface, icp_system
from gsfusion_nb.types import Camera

pytest.importorskip("numba")

MOTION = se3.exp(torch.tensor([0.01, 0.02, -0.01, 0.01, -0.015, 0.02]).double())


def pair(frame, camera: Camera, factor: int = 1):
    """A level from the frame and a surface from it too, of another size and from a pose nearby."""
    level = DepthLevel(
        factor=factor,
        camera=frame.camera,
        depth_m=frame.depth_m,
        normal_C=depth_to_normals(frame.camera, frame.depth_m),
    )
    depth_m = torch.nn.functional.interpolate(
        frame.depth_m[None, None], (camera.height, camera.width)
    )[0, 0]
    normal_W = se3.rotate(frame.T_WC, depth_to_normals(camera, depth_m))
    return (
        level,
        MOTION @ frame.T_WC.double(),
        Surface(depth_m=depth_m, normal_W=normal_W, camera=camera, T_WC=frame.T_WC),
    )


def both(*args, **gates):
    with use_backend("numba"):
        found = icp_system(*args, **gates)
    return icp_system.reference(*args, **gates), found


def assert_same(expected, found):
    """A pixel within rounding of a gate or of a pixel's edge may go the other way."""
    slack = max(2, 2e-3 * expected.n_overlap)
    assert abs(expected.n_inliers - found.n_inliers) <= slack
    assert abs(expected.n_overlap - found.n_overlap) <= slack
    if expected.n_inliers == found.n_inliers and expected.n_overlap == found.n_overlap:
        scale = float(expected.H.abs().max())
        torch.testing.assert_close(found.H, expected.H, rtol=1e-5, atol=1e-5 * scale)
        torch.testing.assert_close(
            found.b,
            expected.b,
            rtol=1e-5,
            atol=1e-5 * float(expected.b.abs().max()) + 1e-9,
        )
        assert found.sum_squares_m2 == pytest.approx(expected.sum_squares_m2, rel=1e-5)
        assert found.sum_weights == pytest.approx(expected.sum_weights, rel=1e-5)
        return True
    return False


@pytest.mark.parametrize("even_to_m", [None, 1.0])
@pytest.mark.parametrize(
    ("width", "height"),
    [(1, 1), (7, 5), (61, 47), (160, 121)],
)
def test_same_sums(make_frames, width, height, even_to_m):
    exact = []
    for frame in make_frames(width, height):
        camera = frame.camera.resized(max(1, width * 3 // 2), height)
        for gates in (
            {"max_distance_m": 0.1, "min_cosine": 0.5},
            {"max_distance_m": 10.0, "min_cosine": -1.1},
        ):
            exact.append(assert_same(*both(*pair(frame, camera), **gates, even_to_m=even_to_m)))
    assert any(exact)


def test_far_from_the_origin_and_out_of_sight(make_frames):
    frame = make_frames(64, 48, n=1, shift=500.0)[0]
    level, T_WC, surface = pair(frame, frame.camera)
    assert_same(*both(level, T_WC, surface, max_distance_m=0.1, min_cosine=0.5))
    T_WC[:3, 3] += 100.0
    expected, found = both(level, T_WC, surface, max_distance_m=0.1, min_cosine=0.5)
    assert expected.n_overlap == found.n_overlap == 0
    assert not found.H.any()
