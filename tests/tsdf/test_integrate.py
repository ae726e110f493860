import dataclasses

import pytest
import torch

from gsfusion_nb.backends import use_backend
from gsfusion_nb.config import TsdfConfig
from gsfusion_nb.data.room import room_sdf
from gsfusion_nb.tsdf import TsdfVolume, fuse_frame_, integrate, tsdf_update
from gsfusion_nb.tsdf.voxel_update import colour_weight
from gsfusion_nb.tsdf.voxels import voxel_centres, voxels_of
from gsfusion_nb.types import Camera

CONFIG = TsdfConfig(voxel_size_m=0.02, truncation_voxels=4.0)


@pytest.mark.parametrize(
    ("average", "expected"),
    [
        ("mean", [0.2, 0.3, 0.4]),
        ("eq9", [0.2, (0.2 + 0.4 * 2) / 3, ((0.2 + 0.8) / 3 * 2 + 0.6 * 3) / 5]),
        ("int16", [6553 / 32767, 9829 / 32767, 13106 / 32767]),
    ],
)
def test_averages_by_hand(average, expected):
    D = torch.ones(1)
    W = torch.zeros(1)
    averages = []
    for d in (0.2, 0.4, 0.6):
        D, W = tsdf_update(
            D,
            W,
            torch.tensor([d * 0.08]),
            truncation_m=0.08,
            max_weight=100.0,
            average=average,
        )
        averages.append(float(D))
    assert averages == pytest.approx(expected, abs=1e-6)
    assert float(W) == 3.0


@pytest.mark.parametrize(
    ("average", "reached"),
    [("mean", 0.502), ("eq9", 0.502), ("int16", 0.5)],
)
def test_averages_where_the_weight_is_at_its_cap(average, reached):
    """A mean that is kept as a whole number no longer follows changes below 100 / 32767; Eq. 9
    follows half of each."""
    D = torch.full((1,), 0.5)
    W = torch.full((1,), 100.0)
    update = {"truncation_m": 0.08, "max_weight": 100.0, "average": average}
    once, _ = tsdf_update(D, W, torch.tensor([0.502 * 0.08]), **update)
    assert float(once) == pytest.approx(
        {"mean": 0.50002, "eq9": 0.501, "int16": 0.5}[average], abs=2e-5
    )
    for _ in range(1000):
        D, W = tsdf_update(D, W, torch.tensor([0.502 * 0.08]), **update)
    assert float(D) == pytest.approx(reached, abs=4e-5)


def test_int16_truncates_towards_zero():
    D = torch.tensor([-9830 / 32767])
    W = torch.ones(1)
    update = {"truncation_m": 1.0, "max_weight": 100.0, "average": "int16"}
    D, _ = tsdf_update(
        D,
        W,
        torch.tensor([-6553.9 / 32767]),
        **update,
    )
    assert round(float(D) * 32767) == -8191  # (-9830 - 6553) / 2 = -8191.5


def test_update_clamps_caps_and_ignores_what_is_hidden():
    D = torch.full((5,), 0.5)
    W = torch.tensor([0.0, 1.0, 1.0, 3.0, 3.0])
    sdf = torch.tensor([0.5, 0.04, -0.0799, -0.0801, -1e9])
    D1, W1 = tsdf_update(D, W, sdf, truncation_m=0.08, max_weight=3.0)
    torch.testing.assert_close(
        D1,
        torch.tensor([1.0, 0.5, (0.5 - 0.0799 / 0.08) / 2, 0.5, 0.5]),
    )
    assert W1.tolist() == [1.0, 2.0, 2.0, 3.0, 3.0]
    # At the cap the mean becomes a filter with gain 1 / 3.
    D2, W2 = tsdf_update(
        D1,
        W1.new_full((5,), 3.0),
        sdf.new_full((5,), 0.08),
        truncation_m=0.08,
        max_weight=3.0,
    )
    torch.testing.assert_close(D2, D1 + (1 - D1) / 3)
    assert W2.tolist() == [3.0] * 5
    assert tsdf_update(
        D[:0],
        W[:0],
        sdf[:0],
        truncation_m=0.1,
        max_weight=9.0,
    )[0].shape == (0,)


@pytest.mark.parametrize(("sdf", "expected"), [("z", 0.625), ("ray", 0.644235)])
def test_one_voxel_by_hand(sdf, expected, make_frame):
    """Voxel at (0.5, 0, 2.0) in the camera frame, depth 2.05, truncation 0.08."""
    camera = Camera(
        width=200,
        height=100,
        fx=200.0,
        fy=200.0,
        cx=100.0,
        cy=50.0,
    )
    config = TsdfConfig(voxel_size_m=0.01, truncation_voxels=8.0, sdf=sdf)
    volume = TsdfVolume(config)
    centre = torch.tensor([[0.105, 0.205, 0.305]])
    T_WC = torch.eye(4)
    T_WC[:3, 3] = centre[0] - torch.tensor([0.5, 0.0, 2.0])
    report = integrate(
        volume,
        make_frame(
            torch.full((100, 200), 2.05),
            camera,
            T_WC,
        ),
    )
    sample = volume.sample_nearest(centre)
    assert float(sample.D) == pytest.approx(expected, abs=2e-5)
    assert float(sample.W) == 1.0
    # u = 200 * 0.25 + 100 = 150: the left edge of pixel 150, whose colour is its centre over the
    # width
    assert float(sample.rgb[0, 0]) == pytest.approx(150.5 / 200, abs=0.006)
    assert report.new_blocks == volume.n_blocks
    assert report.updated_voxels == int((volume.W > 0).sum())


def test_three_voxels_and_three_frames_by_hand(make_frame):
    """A camera at (1, 2, 3) that looks along the world's x axis, its x to the left of y. The depth
    image rises by 1 mm per column, so D tells which pixel was read: u = 100 Y / X + 50 for a voxel
    X ahead and Y to the right."""
    camera = Camera(
        width=100,
        height=80,
        fx=100.0,
        fy=100.0,
        cx=50.0,
        cy=40.0,
    )
    T_WC = torch.tensor(
        [[0.0, 0.0, 1.0, 1.0], [-1.0, 0.0, 0.0, 2.0], [0.0, -1.0, 0.0, 3.0], [0.0, 0.0, 0.0, 1.0]]
    )
    volume = TsdfVolume(
        TsdfConfig(voxel_size_m=0.02, truncation_voxels=5.0, max_weight=2.0, sdf="z")
    )
    step = 0.001 * torch.arange(100.0).expand(80, 100)
    for base_m in (2.0, 2.02, 1.96):
        integrate(volume, make_frame(base_m + step, camera, T_WC))
    # 2.05 m ahead and 0.21, -0.33 to the right: u = 60.24 and 33.90; 2.31 m ahead: behind every
    # band
    points = torch.tensor([[3.05, 1.79, 2.99], [3.05, 2.33, 3.21], [3.31, 1.79, 2.99]])
    s = volume.sample_nearest(points)
    first, second, third = (torch.tensor([b + 0.060, b + 0.033]) - 2.05 for b in (2.0, 2.02, 1.96))
    mean = (first / 0.1 + second / 0.1) / 2
    torch.testing.assert_close(
        s.D[:2],
        (mean + third / 0.1) / 2,
        atol=1e-5,
        rtol=0,
    )  # w_max = 2: mean of old and new
    assert s.D[2] == 1.0
    assert s.W.tolist() == [2.0, 2.0, 0.0]
    torch.testing.assert_close(
        s.rgb[:2, 0],
        torch.tensor([60.5, 33.5]) / 100,
    )


def test_the_image_ends_where_its_last_pixel_does(make_frame):
    """Voxels whose centres project to u = -0.5, 0.5, 7.5 and 8.5 of an image 8 pixels wide."""
    camera = Camera(
        width=8,
        height=4,
        fx=10.0,
        fy=10.0,
        cx=4.0,
        cy=2.0,
    )
    volume = TsdfVolume(TsdfConfig(voxel_size_m=0.1, truncation_voxels=4.0))
    x = torch.tensor([-0.45, -0.35, 0.35, 0.45])  # at z = 1: u = 10 x + 4
    volume.add_blocks(torch.tensor([[i, j, k] for i in (-1, 0) for j in (-1, 0) for k in (0, 1)]))
    T_WC = torch.eye(4)
    T_WC[2, 3] = -0.05  # puts voxel centres at z = 1
    integrate(volume, make_frame(torch.ones(4, 8), camera, T_WC))
    points = torch.stack(
        [x, torch.full((4,), 0.05), torch.full((4,), 0.95)],
        dim=1,
    )
    assert volume.sample_nearest(points).W.tolist() == [0.0, 1.0, 1.0, 0.0]


def test_a_pixel_without_depth_says_nothing(make_frame, camera):
    depth = torch.full((120, 160), 1.0)
    depth[:, :80] = 0.0
    depth[:60] = torch.inf
    depth[60:70] = 0.3  # nearer than near_m
    volume = TsdfVolume(CONFIG)
    volume.add_blocks(
        torch.tensor([[i, j, k] for i in range(-2, 2) for j in range(-2, 2) for k in range(5, 7)])
    )
    integrate(volume, make_frame(depth, camera))
    seen = volume.W > 0
    assert int(seen.sum()) > 100
    centres = voxel_centres(voxels_of(volume.block_coords), volume.config.voxel_size_m)[seen]
    assert bool((centres[:, 0] * 140 / centres[:, 2] + 83 >= 80).all())
    assert bool((centres[:, 1] * 150 / centres[:, 2] + 57.5 >= 70).all())


@pytest.mark.parametrize("sdf", ["z", "ray"])
def test_the_place_in_the_world_makes_no_difference(
    sdf, camera, look_from, sphere_depth, make_frame
):
    config = dataclasses.replace(CONFIG, sdf=sdf, max_weight=3.0, voxel_size_m=1 / 64)
    volumes = []
    for offset_m in (0.0, -640.0):
        volume = TsdfVolume(config)
        for position in (
            (1.3, 0.2, 0.1),
            (1.2, 0.4, -0.3),
            (0.6, -1.2, 0.5),
            (0.2, 1.3, 0.3),
            (1.2, 0.3, -0.2),
        ):
            T_WC = look_from(position)
            depth = sphere_depth(camera, T_WC)
            depth[:, 100:110] = 3.0  # something far behind
            # exact in float32, here and there
            T_WC[:3, 3] = (T_WC[:3, 3] * 2**13).round() / 2**13 + offset_m
            integrate(volume, make_frame(depth, camera, T_WC))
        volumes.append(volume)
    here, there = volumes
    rows = there.index.find(here.block_coords.long() - 640 * 8)
    assert float((rows < 0).double().mean()) < 0.01  # blocks that a ray touches at a corner
    at_both = (rows >= 0).nonzero()[:, 0]
    rows = rows[rows >= 0]
    same = here.W[at_both] == there.W[rows]
    assert float((~same).double().mean()) < 1e-4
    error = (here.D[at_both] - there.D[rows]).abs()[same]
    assert float(error.quantile(0.999)) < 1e-6
    assert float(here.W.max()) == 3.0


def test_the_rooms_distance_field(room_volume):
    """Against the exact distance in the built-in room, near surfaces: the stored one is along
    rays."""
    volume, _ = room_volume
    voxel_m = volume.config.voxel_size_m
    seen = (volume.W > 0) & (torch.arange(512) % 10 == 0)
    assert int(seen.sum()) > 10_000
    true_m = room_sdf(
        voxel_centres(voxels_of(volume.block_coords), volume.config.voxel_size_m)[seen]
    )
    stored_m = volume.D[seen] * volume.config.truncation_m
    clear = true_m.abs() > voxel_m
    near = true_m.abs() < voxel_m
    assert float((stored_m.sign() == true_m.sign())[clear].double().mean()) > 0.99
    assert float((stored_m - true_m)[near].abs().median()) < 0.5 * voxel_m


def test_sphere_surface(camera, look_from, sphere_depth, make_frame):
    # seen at up to 55 degrees
    volume = TsdfVolume(dataclasses.replace(CONFIG, truncation_voxels=8.0))
    for position in (
        (1.6, 0, 0),
        (0, 1.6, 0),
        (0, 0, 1.6),
        (-1.6, 0, 0),
        (0, -1.6, 0.1),
        (0, 0, -1.6),
    ):
        T_WC = look_from(tuple(map(float, position)))
        integrate(volume, make_frame(sphere_depth(camera, T_WC), camera, T_WC))
    d = torch.nn.functional.normalize(
        torch.randn(2000, 3, generator=torch.Generator().manual_seed(1)),
        dim=1,
    )
    inner, ok_in = volume.interpolate(d * 0.48)
    outer, ok_out = volume.interpolate(d * 0.52)
    # the rest is seen at 70 degrees, and ends behind the band
    assert float(ok_in.float().mean()) > 0.95
    assert float(ok_out.float().mean()) > 0.95
    assert float((inner[ok_in] < 0).float().mean()) > 0.99
    # behind a silhouette the outside looks hidden
    assert float((outer[ok_out] > 0).float().mean()) > 0.97


def test_plane_and_free_space(camera, make_frame):
    volume = TsdfVolume(dataclasses.replace(CONFIG, sdf="z"))
    integrate(volume, make_frame(torch.full((120, 160), 1.0), camera))
    far = integrate(volume, make_frame(torch.full((120, 160), 2.0), camera))
    assert far.new_blocks > 0
    z = torch.tensor(
        [[0.0, 0.0, 0.97], [0.0, 0.0, 1.03], [0.0, 0.0, 1.97], [0.0, 0.0, 2.07], [0.0, 0.0, 2.11]]
    )
    s = volume.sample_nearest(z)
    # First seen at 0.375 and -0.375 of the band, then both as free; behind the second plane; beyond
    # its band.
    torch.testing.assert_close(
        s.D,
        torch.tensor([(0.375 + 1) / 2, (-0.375 + 1) / 2, 0.375, -0.875, 1.0]),
        atol=1e-4,
        rtol=0,
    )
    assert s.W.tolist() == [2.0, 2.0, 1.0, 1.0, 0.0]


def test_a_camera_inside_the_map_skips_what_is_beside_it(camera, make_frame, filled_volume):
    """Blocks around and behind the camera: no division by zero, nothing behind the camera is
    updated."""
    volume = filled_volume(
        lambda p: p[..., 2] * 0 + 1,
        (-3, -3, -3),
        (3, 3, 3),
        CONFIG,
    )
    integrate(volume, make_frame(torch.full((120, 160), 1.0), camera))
    ahead = volume.sample_nearest(
        torch.tensor([[0.0, 0.0, 0.09], [0.0, 0.0, 0.31], [0.0, 0.0, -0.09], [0.3, 0.0, 0.05]])
    )
    assert ahead.W.tolist() == [2.0, 2.0, 1.0, 1.0]
    assert bool(torch.isfinite(volume.D).all())


def test_weights_of_colours_by_hand():
    """A band of 1.5 voxels of 2 cm: half of the weight 1.5 cm from the surface, none beyond 3
    cm."""
    sdf = torch.tensor([0.0, 0.015, -0.015, 0.04, 0.04, 0.0])
    z = torch.tensor([2.0, 2.0, 1.0, 1.0, 1.0, 0.05])
    had = torch.tensor([1.0, 1.0, 1.0, 1.0, 0.0, 1.0])
    weights = {"colour_band_voxels": 1.5, "colour_by_distance": True}
    w = colour_weight(sdf, z, had, dataclasses.replace(CONFIG, **weights))
    torch.testing.assert_close(w, torch.tensor([0.25, 0.125, 0.5, 0.0, 1e-3, 100.0]))
    w = colour_weight(
        sdf, z, had, dataclasses.replace(CONFIG, **weights | {"colour_by_distance": False})
    )
    torch.testing.assert_close(w, torch.tensor([1.0, 0.5, 0.5, 0.0, 1e-3, 1.0]))
    w = colour_weight(
        sdf, z, had, dataclasses.replace(CONFIG, **weights | {"colour_band_voxels": 0.0})
    )
    torch.testing.assert_close(w, torch.tensor([0.25, 0.25, 1.0, 1.0, 1.0, 100.0]))
    equal = weights | {"colour_by_distance": False, "colour_weights": "equal"}
    w = colour_weight(sdf, z, had, dataclasses.replace(CONFIG, **equal))
    torch.testing.assert_close(w, torch.tensor([1.0, 1.0, 1.0, 0.0, 1e-3, 1.0]))


def test_a_near_colour_counts_more_and_one_behind_the_surface_not(camera, make_frame):
    """Black from 1 m, then white from 2 m: a fifth of white. A voxel 3 cm behind, of which nothing
    nearer is seen, has the mean of both."""
    volume = TsdfVolume(dataclasses.replace(CONFIG, sdf="z"))
    camera = camera.resized(16, 12)
    back = torch.eye(4)
    back[2, 3] = -1.0
    integrate(
        volume,
        make_frame(torch.full((12, 16), 1.01), camera, rgb=torch.zeros(12, 16, 3)),
    )
    integrate(
        volume,
        make_frame(torch.full((12, 16), 2.01), camera, back, rgb=torch.ones(12, 16, 3)),
    )
    at = volume.sample_nearest(torch.tensor([[0.001, 0.001, 1.011], [0.001, 0.001, 1.051]]))
    assert at.W.tolist() == [2.0, 2.0]
    near = 1.01**-2
    far = 2.01**-2
    torch.testing.assert_close(
        at.rgb[:, 0],
        torch.tensor([far / (near + far), 0.5]),
        atol=1e-4,
        rtol=0,
    )
    torch.testing.assert_close(
        at.W_rgb,
        torch.tensor([near + far, 2e-3]),
        atol=1e-4,
        rtol=0,
    )


def test_a_map_saved_without_weights_of_colours_goes_on(camera, make_frame):
    """As an earlier version wrote it: each colour then counts as often as its voxel was
    observed."""
    volume = TsdfVolume(CONFIG)
    integrate(volume, make_frame(torch.full((120, 160), 1.0), camera))
    state = volume.state_dict()
    assert not torch.equal(state.pop("W_rgb"), volume.W)
    again = TsdfVolume(CONFIG)
    again.load_state_dict(state)
    assert torch.equal(again.W_rgb, volume.W)
    assert torch.equal(again.rgb_planes, volume.rgb_planes)


def test_colour_mean_does_not_stall(camera, make_frame):
    """Two grey levels at weight 100, where 8 bits would not move at all: 0.99^50 of the difference
    is left."""
    plain = dataclasses.replace(CONFIG, sdf="z", colour_band_voxels=0.0, colour_by_distance=False)
    volume = TsdfVolume(plain)
    camera = camera.resized(16, 12)
    depth = torch.full((12, 16), 1.0)
    integrate(volume, make_frame(depth, camera, rgb=torch.zeros(12, 16, 3)))
    volume.W[volume.W > 0] = 100.0
    frame = make_frame(
        depth,
        camera,
        rgb=torch.full((12, 16, 3), 2 / 255),
    )
    for _ in range(50):
        integrate(volume, frame)
    got = volume.sample_nearest(torch.tensor([[0.0, 0.0, 0.99]])).rgb
    assert float(got[0, 0]) == pytest.approx((1 - 0.99**50) * 2 / 255, rel=1e-4)


def test_opencv_finds_its_surface_where_ours_is(camera, make_frame, look_from, sphere_depth):
    cv2 = pytest.importorskip("cv2")
    if not hasattr(cv2, "Volume"):
        pytest.skip(f"OpenCV {cv2.__version__} has no TSDF volume (5.0 and later do)")
    import numpy as np

    size = 96
    voxel = 0.02
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
    theirs = cv2.Volume(cv2.VolumeType_TSDF, settings)
    ours = TsdfVolume(CONFIG)
    for position in ((1.4, 0.1, 0.2), (1.2, 0.8, 0.1)):
        T_WC = look_from(position)
        depth = sphere_depth(camera, T_WC)
        theirs.integrate(depth.numpy(), T_WC.numpy())
        integrate(ours, make_frame(depth, camera, T_WC))
    points, _ = theirs.fetchPointsNormals()
    points = torch.from_numpy(
        np.asarray(points).reshape(-1, np.asarray(points).shape[-1])[:, :3].copy()
    )
    assert points.shape[0] > 1000
    # OpenCV writes and reads its voxels at points half a voxel apart, which shifts its sphere;
    # compare the shape.
    fit = torch.linalg.lstsq(
        torch.cat([2 * points, torch.ones_like(points[:, :1])], 1),
        (points**2).sum(1)[:, None],
    )
    shift = fit.solution[:3, 0]
    assert float(shift.abs().max()) < 0.7 * voxel
    D, valid = ours.interpolate(points - shift)
    error = D[valid].abs() * ours.config.truncation_m
    assert float(valid.float().mean()) > 0.85  # theirs also fills cells with unobserved corners
    assert float(error.median()) < 0.1 * voxel


def test_frames_that_change_nothing(camera, make_frame):
    volume = TsdfVolume(CONFIG)
    report = integrate(volume, make_frame(torch.zeros(120, 160), camera))
    assert (report.new_blocks, report.updated_voxels) == (0, 0)
    integrate(volume, make_frame(torch.full((120, 160), 1.0), camera))
    state = volume.state_dict()
    away = torch.diag(torch.tensor([-1.0, 1.0, -1.0, 1.0]))  # looks the other way
    report = integrate(volume, make_frame(torch.zeros(120, 160), camera, away))
    assert report.updated_voxels == 0
    hidden = integrate(volume, make_frame(torch.full((120, 160), 0.5), camera))
    assert torch.equal(state["W"], volume.W[: state["W"].shape[0]]) or hidden.updated_voxels > 0
    # behind what the last frame saw
    assert float(volume.sample_nearest(torch.tensor([[0.0, 0.0, 0.99]])).W) == 1.0


def test_inputs_are_not_modified(camera, make_frame):
    frame = make_frame(torch.full((120, 160), 1.0), camera)
    copies = [t.clone() for t in (frame.depth_m, frame.rgb, frame.T_WC)]
    integrate(TsdfVolume(CONFIG), frame)
    for before, after in zip(
        copies,
        (frame.depth_m, frame.rgb, frame.T_WC),
        strict=True,
    ):
        assert torch.equal(before, after)


@pytest.mark.parametrize("backend", ["reference", "auto"])
def test_a_volume_without_blocks_refuses_a_frame_that_needs_some(room_volume, backend):
    frame = room_volume[1][0]
    with use_backend(backend):
        with pytest.raises(
            ValueError, match=r"has no voxel blocks.*integrate\(volume, frame\) makes those"
        ):
            fuse_frame_(TsdfVolume(CONFIG), frame)
        without_depth = dataclasses.replace(frame, depth_m=torch.zeros_like(frame.depth_m))
        assert fuse_frame_(TsdfVolume(CONFIG), without_depth) == 0
        assert integrate(TsdfVolume(CONFIG), frame).updated_voxels > 0
