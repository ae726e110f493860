"""The fused update against the reference: distance, weight, colour of every voxel."""

import dataclasses

import pytest
import torch

from gsfusion_nb.backends import use_backend
from gsfusion_nb.config import TsdfConfig
from gsfusion_nb.tsdf import TsdfVolume, integrate, tsdf_update
from gsfusion_nb.tsdf.integrate import fuse_frame_

pytest.importorskip("numba")

PLAIN = {"colour_band_voxels": 0.0, "colour_by_distance": False}
CONFIG = TsdfConfig(voxel_size_m=0.02, truncation_voxels=4.0, max_weight=3.0, **PLAIN)


def both(config, frames):
    """The two volumes after the frames, and the reports."""
    volumes = []
    reports = []
    for backend in ("reference", "numba"):
        volume = TsdfVolume(config)
        with use_backend(backend):
            reports.append([integrate(volume, frame) for frame in frames])
        volumes.append(volume)
    return volumes, reports


D_ROUNDING = 4e-6
"""Up to 4 m away the distance of a voxel is the sum of two float32 numbers: 2.6e-7 m, of a
truncation of 0.08 m."""


def assert_same(volumes, flips=2e-5):
    """Equal to rounding but for voxels that project within rounding of a pixel's border or of the
    band's end."""
    a, b = volumes
    assert torch.equal(a.block_coords, b.block_coords)
    off = (
        (a.W != b.W)
        | ((a.D - b.D).abs() > D_ROUNDING)
        | ((a.rgb_planes - b.rgb_planes).abs().amax(1) > 2e-6)
    )
    assert bool(torch.isfinite(b.D).all())
    assert bool(torch.isfinite(b.rgb_planes).all())
    assert float(off.double().sum()) <= flips * max(1, off.numel()), (
        f"{int(off.sum())} of {off.numel()} voxels differ"
    )


@pytest.mark.parametrize("sdf", ["z", "ray"])
@pytest.mark.parametrize("eight_bit", [True, False])
@pytest.mark.parametrize(
    ("width", "height"),
    [(160, 120), (37, 29), (16, 1), (1, 1)],
)
def test_same_voxels(width, height, eight_bit, sdf, make_frames):
    frames = make_frames(width, height, n=5, eight_bit=eight_bit)
    volumes, reports = both(dataclasses.replace(CONFIG, sdf=sdf, near_m=0.0), frames)
    assert_same(volumes)
    for a, b in zip(*reports, strict=True):
        assert a.new_blocks == b.new_blocks
        assert abs(a.updated_voxels - b.updated_voxels) <= 1e-4 * a.updated_voxels
    assert width < 100 or float(volumes[1].W.max()) == 3.0


@pytest.mark.parametrize(
    ("band", "by_distance"),
    [(1.5, True), (1.5, False), (0.0, True)],
)
@pytest.mark.parametrize("eight_bit", [True, False])
def test_weighted_colours(eight_bit, band, by_distance, make_frames):
    """A distance that is off by its rounding changes a weight by at most that part of the band."""
    frames = make_frames(160, 120, n=5, eight_bit=eight_bit)
    rounding = 1e-5
    config = dataclasses.replace(
        CONFIG, colour_band_voxels=band, colour_by_distance=by_distance, max_weight=100.0
    )
    (a, b), _ = both(config, frames)
    off = (a.W_rgb - b.W_rgb).abs() > len(frames) * rounding
    moved = (a.rgb_planes - b.rgb_planes).abs().amax(1) * a.W_rgb.clamp(max=1.0)
    off |= moved > len(frames) * rounding
    assert float(off.double().mean()) < 2e-5
    plain, _ = both(CONFIG, frames)
    assert float((plain[1].rgb_planes - b.rgb_planes).abs().amax(1)[b.W > 1].mean()) > 1e-3
    assert torch.equal(a.W > 0, a.W_rgb > 0)


def test_equal_weights_of_colours(make_frames):
    """As with falling weights, but a distance that is off by its rounding may change which side of
    the border it is."""
    colours = {
        "colour_band_voxels": 1.0,
        "colour_weights": "equal",
        "colour_by_distance": False,
        "max_weight": 100.0,
    }
    frames = make_frames(160, 120, n=5)
    (a, b), _ = both(dataclasses.replace(CONFIG, **colours), frames)
    assert float((a.W_rgb != b.W_rgb).double().mean()) < 2e-5
    weights = b.W_rgb[b.W_rgb >= 1]
    # with a thousandth of each from outside the band
    assert float((weights - weights.round()).abs().max()) < 0.1
    falling, _ = both(
        dataclasses.replace(CONFIG, **colours | {"colour_weights": "falling"}), frames
    )
    assert float((falling[1].W_rgb < b.W_rgb).double().mean()) > 1e-3


@pytest.mark.parametrize("average", ["eq9", "int16"])
@pytest.mark.parametrize("max_weight", [3.0, 255.0])
def test_published_averages(average, max_weight, make_frames):
    config = dataclasses.replace(CONFIG, average=average, max_weight=max_weight)
    frames = make_frames(160, 120, n=5)
    (a, b), _ = both(config, frames)
    if average == "eq9":
        assert_same((a, b))
    else:  # the last bit of a distance decides between two neighbouring whole numbers
        assert float(((a.D - b.D).abs() > 1 / 32767 + D_ROUNDING).double().mean()) < 2e-5
        assert float(((a.D - b.D).abs() > D_ROUNDING).double().mean()) < 0.02
    mean, _ = both(dataclasses.replace(config, average="mean"), frames)
    assert not torch.allclose(
        mean[1].D,
        b.D,
        atol=D_ROUNDING,
        rtol=0,
    )
    assert torch.equal(mean[1].W, b.W)
    assert torch.equal(mean[1].rgb_planes, b.rgb_planes)


@pytest.mark.parametrize("average", ["eq9", "int16"])
def test_published_averages_of_equal_distances(average):
    """16,000 voxels of every weight, whole-number D of either sign, and distances on and off whole
    numbers."""
    from numba import njit

    from gsfusion_nb.kernels.integrate.averages import AVERAGES, as_published
    from gsfusion_nb.kernels.runtime.numba.simd import load, store

    @njit
    def fold(D, d, W, W_k, code, out):
        for i in range(0, len(D), 16):
            store(
                out,
                i,
                as_published(load(D, i), load(d, i), load(W, i), load(W_k, i), code),
            )

    g = torch.Generator().manual_seed(0)
    D, d = (torch.randint(-32767, 32768, (16_000,), generator=g) / 32767 for _ in range(2))
    d[::2] = 2 * torch.rand(8_000, generator=g) - 1
    d[:64] = torch.tensor([-1.0, 0.0, 1.0, -0.0]).repeat(16)
    W = torch.randint(0, 256, (16_000,), generator=g).float()
    d.clamp_(min=-0.999)
    expected, W_k = tsdf_update(D, W, d, truncation_m=1.0, max_weight=255.0, average=average)
    got = torch.empty_like(D)
    fold(
        D.numpy(),
        d.numpy(),
        W.numpy(),
        W_k.numpy(),
        AVERAGES[average],
        got.numpy(),
    )
    torch.testing.assert_close(got, expected, rtol=0, atol=5e-7)


def test_a_camera_inside_the_map(make_frames):
    """Blocks around and behind the camera: nothing behind it is updated, and nothing is divided by
    zero."""
    frame = make_frames(64, 47, n=1)[0]
    frame = dataclasses.replace(
        frame,
        T_WC=torch.eye(4),
        depth_m=torch.full((47, 64), 1.0),
    )
    axis = torch.arange(-4, 5)
    volumes = [TsdfVolume(CONFIG) for _ in range(2)]
    for volume in volumes:
        volume.add_blocks(
            torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), dim=-1).view(-1, 3)
        )
    fuse_frame_.reference(volumes[0], frame)
    with use_backend("numba"):
        updated = fuse_frame_(volumes[1], frame)
    assert_same(volumes)
    assert updated == int((volumes[0].W > 0).sum())
    behind = (volumes[1].block_coords[:, 2] < -1)[:, None]
    assert not bool((volumes[1].W * behind).any())


def test_what_is_beyond_far_m_is_left_alone(make_frames):
    near = make_frames(64, 47, n=1)[0]
    far = make_frames(64, 47, n=1)[0]
    far = dataclasses.replace(far, depth_m=torch.full((47, 64), 30.0))
    config = dataclasses.replace(CONFIG, far_m=1.5)
    volumes, _ = both(config, [near, far])
    assert_same(volumes)


@pytest.mark.parametrize("value", [1.2, -0.2])
@pytest.mark.parametrize("column", [0, 40])
def test_colours_that_are_no_bytes(value, column, make_frames):
    """306 and -51 are whole numbers, too; column 40 is beyond the last full vector of the row."""
    frame = make_frames(41, 31, n=1)[0]
    rgb = frame.rgb.clone()
    rgb[:, column] = value
    volumes, _ = both(CONFIG, [dataclasses.replace(frame, rgb=rgb)])
    assert_same(volumes)
