import dataclasses

import pytest
import torch

from gsfusion_nb.config import TsdfConfig
from gsfusion_nb.geometry import se3
from gsfusion_nb.tsdf import TsdfVolume, integrate, tsdf_update
from gsfusion_nb.tsdf.allocate import allocate
from gsfusion_nb.types import Camera

CONFIG = TsdfConfig(voxel_size_m=0.02, truncation_voxels=4.0)


def test_running_mean_by_hand():
    D, W = torch.ones(1), torch.zeros(1)
    means, printed = [], []
    w = literal = 0.0
    for d in (0.2, 0.4, 0.6):
        D, W = tsdf_update(D, W, torch.tensor([d * 0.08]), truncation_m=0.08, max_weight=100.0)
        means.append(float(D))
        w_k = min(100.0, w + 1)
        literal, w = (literal * w + d * w_k) / (w + w_k), w_k  # Eq. 9 as printed
        printed.append(literal)
    assert means == pytest.approx([0.2, 0.3, 0.4], abs=1e-6)
    assert printed == pytest.approx([0.2, 1 / 3, 0.49333], abs=1e-4)
    assert float(W) == 3.0


def test_update_clamps_caps_and_ignores_what_is_hidden():
    D, W = torch.full((5,), 0.5), torch.tensor([0.0, 1.0, 1.0, 3.0, 3.0])
    sdf = torch.tensor([0.5, 0.04, -0.0799, -0.0801, -1e9])
    D1, W1 = tsdf_update(D, W, sdf, truncation_m=0.08, max_weight=3.0)
    torch.testing.assert_close(D1, torch.tensor([1.0, 0.5, (0.5 - 0.0799 / 0.08) / 2, 0.5, 0.5]))
    assert W1.tolist() == [1.0, 2.0, 2.0, 3.0, 3.0]
    # At the cap the mean becomes a filter with gain 1 / 3.
    D2, W2 = tsdf_update(D1, W1.new_full((5,), 3.0), sdf.new_full((5,), 0.08), truncation_m=0.08, max_weight=3.0)
    torch.testing.assert_close(D2, D1 + (1 - D1) / 3)
    assert W2.tolist() == [3.0] * 5
    assert tsdf_update(D[:0], W[:0], sdf[:0], truncation_m=0.1, max_weight=9.0)[0].shape == (0,)


@pytest.mark.parametrize(("sdf", "expected"), [("z", 0.625), ("ray", 0.644235)])
def test_one_voxel_by_hand(sdf, expected, make_frame):
    """Voxel at (0.5, 0, 2.0) in the camera frame, depth 2.05, truncation 0.08."""
    camera = Camera(width=200, height=100, fx=200.0, fy=200.0, cx=100.0, cy=50.0)
    config = TsdfConfig(voxel_size_m=0.01, truncation_voxels=8.0, sdf=sdf)
    volume = TsdfVolume(config)
    centre = torch.tensor([[0.105, 0.205, 0.305]])
    T_WC = torch.eye(4)
    T_WC[:3, 3] = centre[0] - torch.tensor([0.5, 0.0, 2.0])
    report = integrate(volume, make_frame(torch.full((100, 200), 2.05), camera, T_WC))
    sample = volume.sample_nearest(centre)
    assert float(sample.D) == pytest.approx(expected, abs=2e-5)
    assert float(sample.W) == 1.0
    # u = 200 * 0.25 + 100 = 150: the left edge of pixel 150, whose colour is its centre over the width
    assert float(sample.rgb[0, 0]) == pytest.approx(150.5 / 200, abs=0.006)
    assert report.new_blocks == volume.n_blocks
    assert report.updated_voxels == int((volume.W > 0).sum())


def naive_integrate(D, W, rgb, centres, frame, config):
    """Every voxel by itself, float64, straight from the definition."""
    camera = frame.camera
    p = se3.apply(se3.inverse(frame.T_WC.double()), centres)
    x, y, z = p.unbind(-1)
    u, v = (camera.fx * x / z + camera.cx).floor(), (camera.fy * y / z + camera.cy).floor()
    ok = (z > 0) & (u >= 0) & (v >= 0) & (u < camera.width) & (v < camera.height)
    u, v = u.clamp(0, camera.width - 1).long(), v.clamp(0, camera.height - 1).long()
    depth = frame.depth_m.double()[v, u]
    sdf = (depth - z) * (p.norm(dim=-1) / z if config.sdf == "ray" else 1.0)
    ok &= (depth >= config.near_m) & (sdf > -config.truncation_m)
    W1 = (W + 1).clamp(max=config.max_weight)
    D1 = (D * (W1 - 1) + (sdf / config.truncation_m).clamp(-1, 1)) / W1
    rgb1 = (rgb * (W1 - 1)[..., None] + frame.rgb.double()[v, u]) / W1[..., None]
    return torch.where(ok, D1, D), torch.where(ok, W1, W), torch.where(ok[..., None], rgb1, rgb)


@pytest.mark.parametrize("sdf", ["z", "ray"])
@pytest.mark.parametrize("far_offset", [0.0, -640.0])
def test_against_every_voxel_by_itself(
    sdf, far_offset, camera, look_from, sphere_depth, make_frame, centres_of, generator
):
    config = dataclasses.replace(CONFIG, sdf=sdf, max_weight=3.0, voxel_size_m=1 / 64)
    volume, frames = TsdfVolume(config), []
    for position in ((1.3, 0.2, 0.1), (1.2, 0.4, -0.3), (0.6, -1.2, 0.5), (0.2, 1.3, 0.3), (1.2, 0.3, -0.2)):
        T_WC = look_from(position)
        depth = sphere_depth(camera, T_WC)
        depth[torch.rand(depth.shape, generator=generator) < 0.1] = 0.0
        depth[:, 100:110] = 3.0  # something far behind, and a hole
        T_WC[:3, 3] += far_offset
        frames.append(make_frame(depth, camera, T_WC))
    frames.append(make_frame(torch.full((120, 160), 0.3), camera, frames[0].T_WC))  # nearer than near_m: nothing
    for frame in frames:
        allocate(volume, frame)  # so that every frame meets the same blocks
    centres = centres_of(volume)
    D, W, rgb = (t.double() for t in (volume.D, volume.W, volume.rgb))
    for frame in frames:
        report = integrate(volume, frame)
        before, (D, W, rgb) = W, naive_integrate(D, W, rgb, centres, frame, config)
        assert report.new_blocks == 0
    assert torch.equal(W, before)  # the last frame
    # A projection within rounding of a pixel's edge, or an sdf of the band's, may fall on the other side.
    same = volume.W.double() == W
    assert float((~same).double().mean()) < (2e-4 if far_offset == 0 else 5e-3)
    for got, expected, tolerance in ((volume.D, D, 2e-5), (volume.rgb, rgb, 2e-6)):
        error = (got - expected).abs().flatten(2).amax(-1) if got.ndim == 3 else (got - expected).abs()
        assert float(error[same].quantile(0.999 if far_offset == 0 else 0.97)) < tolerance * (
            1 if far_offset == 0 else 10
        )
    assert bool(torch.isfinite(volume.D).all())
    assert bool(torch.isfinite(volume.rgb).all())
    assert float(volume.W.max()) == 3.0


def test_sphere_surface(camera, look_from, sphere_depth, make_frame):
    volume = TsdfVolume(dataclasses.replace(CONFIG, truncation_voxels=8.0))  # seen at up to 55 degrees
    for position in ((1.6, 0, 0), (0, 1.6, 0), (0, 0, 1.6), (-1.6, 0, 0), (0, -1.6, 0.1), (0, 0, -1.6)):
        T_WC = look_from(tuple(map(float, position)))
        integrate(volume, make_frame(sphere_depth(camera, T_WC), camera, T_WC))
    d = torch.nn.functional.normalize(torch.randn(2000, 3, generator=torch.Generator().manual_seed(1)), dim=1)
    inner, ok_in = volume.interpolate(d * 0.48)
    outer, ok_out = volume.interpolate(d * 0.52)
    assert float(ok_in.float().mean()) > 0.95  # the rest is seen at 70 degrees, and ends behind the band
    assert float(ok_out.float().mean()) > 0.95
    assert float((inner[ok_in] < 0).float().mean()) > 0.99
    assert float((outer[ok_out] > 0).float().mean()) > 0.97  # behind a silhouette the outside looks hidden


def test_plane_and_free_space(camera, make_frame):
    volume = TsdfVolume(dataclasses.replace(CONFIG, sdf="z"))
    integrate(volume, make_frame(torch.full((120, 160), 1.0), camera))
    far = integrate(volume, make_frame(torch.full((120, 160), 2.0), camera))
    assert far.new_blocks > 0
    z = torch.tensor([[0.0, 0.0, 0.97], [0.0, 0.0, 1.03], [0.0, 0.0, 1.97], [0.0, 0.0, 2.07], [0.0, 0.0, 2.11]])
    s = volume.sample_nearest(z)
    # First seen at 0.375 and -0.375 of the band, then both as free; behind the second plane; beyond its band.
    torch.testing.assert_close(
        s.D, torch.tensor([(0.375 + 1) / 2, (-0.375 + 1) / 2, 0.375, -0.875, 1.0]), atol=1e-4, rtol=0
    )
    assert s.W.tolist() == [2.0, 2.0, 1.0, 1.0, 0.0]


def test_frames_that_change_nothing(camera, make_frame):
    volume = TsdfVolume(CONFIG)
    report = integrate(volume, make_frame(torch.zeros(120, 160), camera))
    assert (report.new_blocks, report.touched_blocks, report.updated_voxels) == (0, 0, 0)
    integrate(volume, make_frame(torch.full((120, 160), 1.0), camera))
    state = volume.state_dict()
    away = torch.diag(torch.tensor([-1.0, 1.0, -1.0, 1.0]))  # looks the other way
    report = integrate(volume, make_frame(torch.zeros(120, 160), camera, away))
    assert report.updated_voxels == 0
    hidden = integrate(volume, make_frame(torch.full((120, 160), 0.5), camera))
    assert torch.equal(state["W"], volume.W[: state["W"].shape[0]]) or hidden.updated_voxels > 0
    assert float(volume.sample_nearest(torch.tensor([[0.0, 0.0, 0.99]])).W) == 1.0  # behind what the last frame saw


def test_inputs_are_not_modified(camera, make_frame):
    frame = make_frame(torch.full((120, 160), 1.0), camera)
    copies = [t.clone() for t in (frame.depth_m, frame.rgb, frame.T_WC)]
    integrate(TsdfVolume(CONFIG), frame)
    for before, after in zip(copies, (frame.depth_m, frame.rgb, frame.T_WC), strict=True):
        assert torch.equal(before, after)


def test_a_camera_inside_the_map_skips_what_is_beside_it(camera, make_frame, filled_volume):
    """Blocks around and behind the camera: no division by zero, nothing behind the camera is updated."""
    volume = filled_volume(lambda p: p[..., 2] * 0 + 1, (-3, -3, -3), (3, 3, 3), CONFIG)
    integrate(volume, make_frame(torch.full((120, 160), 1.0), camera))
    ahead = volume.sample_nearest(
        torch.tensor([[0.0, 0.0, 0.09], [0.0, 0.0, 0.31], [0.0, 0.0, -0.09], [0.3, 0.0, 0.05]])
    )
    assert ahead.W.tolist() == [2.0, 2.0, 1.0, 1.0]
    assert bool(torch.isfinite(volume.D).all())


def test_colour_mean_does_not_stall(camera, make_frame):
    """Two grey levels at weight 100, where 8 bits would not move at all: 0.99^300 of the difference is left."""
    volume, camera = TsdfVolume(dataclasses.replace(CONFIG, sdf="z")), camera.resized(16, 12)
    depth = torch.full((12, 16), 1.0)
    integrate(volume, make_frame(depth, camera, rgb=torch.zeros(12, 16, 3)))
    volume.W[volume.W > 0] = 100.0
    frame = make_frame(depth, camera, rgb=torch.full((12, 16, 3), 2 / 255))
    for _ in range(300):
        integrate(volume, frame)
    got = volume.sample_nearest(torch.tensor([[0.0, 0.0, 0.99]])).rgb
    assert float(got[0, 0]) == pytest.approx(2 / 255, abs=0.12 / 255)


def test_opencv_finds_its_surface_where_ours_is(camera, make_frame, look_from, sphere_depth):
    cv2 = pytest.importorskip("cv2")
    if not hasattr(cv2, "Volume"):
        pytest.skip(f"OpenCV {cv2.__version__} has no TSDF volume (5.0 and later do)")
    import numpy as np

    size, voxel = 96, 0.02
    settings = cv2.VolumeSettings(cv2.VolumeType_TSDF)
    settings.setVoxelSize(voxel)
    settings.setTsdfTruncateDistance(4 * voxel)
    settings.setVolumeResolution(np.array([size] * 3, np.int32))
    pose = np.eye(4, dtype=np.float32)
    pose[:3, 3] = -size * voxel / 2
    settings.setVolumePose(pose)
    settings.setDepthFactor(1.0)
    settings.setMaxWeight(100)
    settings.setIntegrateWidth(camera.width)
    settings.setIntegrateHeight(camera.height)
    K = camera.K.numpy().astype(np.float32)
    K[:2, 2] -= 0.5  # integer pixel centres there
    settings.setCameraIntegrateIntrinsics(K)
    theirs, ours = cv2.Volume(cv2.VolumeType_TSDF, settings), TsdfVolume(CONFIG)
    for position in ((1.4, 0.1, 0.2), (1.2, 0.8, 0.1)):
        T_WC = look_from(position)
        depth = sphere_depth(camera, T_WC)
        theirs.integrate(depth.numpy(), T_WC.numpy())
        integrate(ours, make_frame(depth, camera, T_WC))
    points, _ = theirs.fetchPointsNormals()
    points = torch.from_numpy(np.asarray(points).reshape(-1, np.asarray(points).shape[-1])[:, :3].copy())
    assert points.shape[0] > 1000
    # OpenCV writes and reads its voxels at points half a voxel apart, which shifts its sphere; compare the shape.
    fit = torch.linalg.lstsq(torch.cat([2 * points, torch.ones_like(points[:, :1])], 1), (points**2).sum(1)[:, None])
    shift = fit.solution[:3, 0]
    assert float(shift.abs().max()) < 0.7 * voxel
    D, valid = ours.interpolate(points - shift)
    error = D[valid].abs() * ours.config.truncation_m
    assert float(valid.float().mean()) > 0.85  # theirs also fills cells with unobserved corners
    assert float(error.median()) < 0.1 * voxel
