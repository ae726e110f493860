import pytest
import torch

from gsfusion_nb.config import TsdfConfig
from gsfusion_nb.geometry import se3
from gsfusion_nb.tracking import Surface, tsdf_surface
from gsfusion_nb.tracking.surface import hybrid_surface, smooth_normals
from gsfusion_nb.tsdf import TsdfVolume, integrate
from gsfusion_nb.types import Camera


def test_a_volume_is_a_surface(plane_scene):
    frame = plane_scene("corner").frame(torch.eye(4))
    volume = TsdfVolume(TsdfConfig(voxel_size_m=0.04, truncation_voxels=4.0))
    integrate(volume, frame)
    seen = tsdf_surface(volume)(frame.camera, frame.T_WC)
    exact = plane_scene("corner")(frame.camera, frame.T_WC)
    both = (seen.depth_m > 0) & (exact.depth_m > 0)
    assert float(both.double().mean()) > 0.9
    assert float((seen.depth_m - exact.depth_m).abs()[both].median()) < 2e-3
    assert float((seen.normal_W * exact.normal_W).sum(-1)[both].median()) > 0.99


def test_a_hybrid_takes_the_frame_where_the_model_is_missing_or_off(plane_scene):
    T_WC = se3.exp(torch.tensor([0.1, 0.0, 0.0, 0.0, 0.1, 0.0]))
    scene = plane_scene("wall")
    frame, model = scene.frame(T_WC), scene(scene.frame(T_WC).camera, T_WC)
    depth_m = model.depth_m.clone()
    depth_m[20:40] = 0.0
    depth_m[50:70] += 0.02
    depth_m[80:100] += 0.004
    measured = frame.depth_m.clone()
    measured[:, :30] = 0.0
    model = Surface(depth_m=depth_m, normal_W=model.normal_W, camera=model.camera, T_WC=T_WC)
    mixed = hybrid_surface(model, measured)
    assert torch.equal(mixed.depth_m[20:40, 30:], frame.depth_m[20:40, 30:])
    assert not mixed.depth_m[20:40, :30].any()
    assert torch.equal(mixed.depth_m[52:68, 32:], frame.depth_m[52:68, 32:])
    assert torch.equal(mixed.depth_m[82:98, 32:-2], depth_m[82:98, 32:-2])
    assert torch.equal(mixed.depth_m[50:70, :30], depth_m[50:70, :30])
    torch.testing.assert_close(mixed.normal_W[60, 80], torch.tensor([0.0, 0.0, -1.0]), atol=1e-4, rtol=0)


def test_smoothing_averages_noise_away_and_leaves_the_unknown_unknown(plane_scene, generator):
    T_WC = se3.exp(torch.tensor([0.1, 0.0, 0.0, 0.0, 0.1, 0.0]))
    clean = plane_scene("wall")(plane_scene("wall").frame(T_WC).camera, T_WC)
    noise = 0.5 * torch.randn(clean.normal_W.shape, generator=generator)
    noisy = torch.nn.functional.normalize(clean.normal_W + noise, dim=-1)
    noisy[:10] = 0.0
    model = Surface(depth_m=clean.depth_m, normal_W=noisy, camera=clean.camera, T_WC=T_WC)
    smooth = smooth_normals(model)
    assert not smooth.normal_W[:10].any()
    inner = (slice(12, -2), slice(2, -2))
    before, after = (
        (n * clean.normal_W).sum(-1)[inner].clamp(-1, 1).acos().rad2deg() for n in (noisy, smooth.normal_W)
    )
    assert float(before.mean()) > 25
    assert float(after.mean()) < 0.45 * float(before.mean())
    torch.testing.assert_close(smooth.normal_W[inner].norm(dim=-1), torch.ones_like(after))
    assert torch.equal(smooth.depth_m, model.depth_m)
    # the mean of nine equal vectors, made a unit vector again: some 13 roundings of 2^-24 = 8e-7 of each component
    torch.testing.assert_close(smooth_normals(clean).normal_W[60, 80], clean.normal_W[60, 80], rtol=8e-7, atol=1e-9)


def test_sizes_must_fit():
    camera = Camera(width=4, height=3, fx=1.0, fy=1.0, cx=2.0, cy=1.5)
    with pytest.raises(ValueError, match=r"depth_m of the surface must be \[3, 4\], got \[4, 3\]"):
        Surface(depth_m=torch.zeros(4, 3), normal_W=torch.zeros(4, 3, 3), camera=camera, T_WC=torch.eye(4))
