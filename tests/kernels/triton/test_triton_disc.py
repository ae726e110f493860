"""Disc depth, normals and gradient."""

# pyright: reportFunctionMemberAccess=false

import pytest
import torch

from gsfusion_nb.backends import use_backend
from gsfusion_nb.render import disc_depth, disc_depth_vjp, render_forward


@pytest.mark.parametrize("max_offset", [1.0, None])
@pytest.mark.parametrize(("n", "width", "height"), [(1, 16, 16), (60, 48, 40)])
def test_depth_and_gradients(n, width, height, max_offset, make_scene, make_camera, pose, to, compare, generator):
    params, camera = make_scene(n, 0, scale_m=0.15), make_camera(width, height)
    hit = render_forward.reference(params, camera, pose, opaque_alpha=0.3)[0].hit_index
    v, rows = torch.randn(height, width, generator=generator), torch.rand(n, generator=generator) < 0.5
    expected = disc_depth.reference(params, camera, pose, hit, max_offset=max_offset)
    with use_backend("triton"):
        found = disc_depth(to(params), camera, to(pose), to(hit), max_offset=max_offset)
    compare("disc_depth", "depth_m", found.depth_m, expected.depth_m, 1e-5, share=5e-3)
    compare("disc_depth", "normal_W", found.normal_W, expected.normal_W, 1e-5)
    assert (found.on_plane.cpu() != expected.on_plane).double().mean() <= 5e-3
    for some in (None, rows):
        theirs = disc_depth_vjp.reference(params, camera, pose, hit, v, max_offset=max_offset, rows=some)
        with use_backend("triton"):
            ours = disc_depth_vjp(
                to(params), camera, pose, to(hit), to(v), max_offset=max_offset, rows=None if some is None else to(some)
            )
        for name, a, b in zip(("xyz_W", "quat"), ours, theirs, strict=True):
            compare("disc_depth_vjp", name, a, b, 2e-5, share=2e-2)


def test_wrong_sizes_are_named(make_scene, make_camera, pose, to):
    params, hit = to(make_scene(3, 0)), to(torch.zeros(4, 5, dtype=torch.int64))
    with use_backend("triton"), pytest.raises(ValueError, match=r"hit_index must be \[5, 4\], got \[4, 5\]"):
        disc_depth(params, make_camera(4, 5), pose, hit)
