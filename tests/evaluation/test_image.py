"""PSNR, SSIM, LPIPS and depth error: closed forms, a brute-force SSIM, and views read one by
one."""

import json
import math
import sys

import numpy as np
import pytest
import torch
from jaxtyping import TypeCheckError

from gsfusion_nb.evaluation import (
    NotComputed,
    depth_l1_m,
    expected_depth_m,
    format_metric,
    frame_rates,
    learned_distance,
    lpips,
    lpips_as_released,
    mesh_psnr,
    metrics_as_json,
    psnr,
    score_views,
    ssim,
    ssim_as_released,
)
from gsfusion_nb.evaluation.metrics import METRICS, format_value
from gsfusion_nb.types import Camera, Frame, Mesh, RenderOutput


def picture(generator, height=24, width=31):
    return torch.rand(height, width, 3, generator=generator)


def view_of(rgb, depth_m, alpha=1.0):
    index = torch.zeros(depth_m.shape, dtype=torch.int64)
    return RenderOutput(
        rgb=rgb,
        depth_m=depth_m * alpha,
        alpha=torch.full_like(depth_m, alpha),
        first_index=index,
        dominant_index=index,
    )


def frame_of(index, rgb, depth_m):
    h, w = depth_m.shape
    camera = Camera(
        width=w,
        height=h,
        fx=float(w),
        fy=float(w),
        cx=w / 2,
        cy=h / 2,
    )
    return Frame(
        index=index,
        timestamp_s=0.0,
        rgb=rgb,
        depth_m=depth_m,
        camera=camera,
        T_WC=torch.eye(4),
    )


@pytest.mark.parametrize("offset", [0.2, 1 / 255, 1.0])
def test_psnr_of_a_constant_offset_is_minus_20_log10(offset):
    black = torch.zeros(5, 7, 3, dtype=torch.float64)
    assert psnr(black + offset, black) == pytest.approx(-20 * math.log10(offset), abs=1e-9)


def test_psnr_quantises_to_bytes_with_halves_up():
    black = torch.zeros(2, 2, 3)
    just_below = black + 0.49 / 255
    just_above = black + 0.51 / 255
    assert psnr(just_below, black) == math.inf
    assert psnr(just_above, black) == pytest.approx(20 * math.log10(255), abs=1e-4)


def test_ssim_of_equal_images_is_one_and_falls_with_noise(generator):
    a = picture(generator)
    noise = torch.randn(a.shape, generator=generator)
    values = [ssim(a + s * noise, a) for s in (0.0, 0.02, 0.1, 0.4)]
    assert values[0] == 1.0
    assert values == sorted(values, reverse=True)
    assert ssim(torch.zeros(8, 8, 3), torch.zeros(8, 8, 3)) == 1.0


def test_ssim_matches_its_definition_pixel_by_pixel(generator):
    a, b = ((picture(generator, 9, 12).double() * 255).round() / 255 for _ in range(2))
    tap = np.exp(-(np.arange(-5, 6) ** 2) / (2 * 1.5**2))
    window = np.outer(tap, tap) / tap.sum() ** 2
    total = 0.0
    for c in range(3):
        x, y = (np.pad(image[..., c].numpy(), 5, mode="reflect") for image in (a, b))
        for i in range(9):
            for j in range(12):
                p = x[i : i + 11, j : j + 11]
                q = y[i : i + 11, j : j + 11]
                mp = (window * p).sum()
                mq = (window * q).sum()
                vp = (window * (p - mp) ** 2).sum()
                vq = (window * (q - mq) ** 2).sum()
                cov = (window * (p - mp) * (q - mq)).sum()
                total += (
                    (2 * mp * mq + 1e-4)
                    * (2 * cov + 9e-4)
                    / ((mp**2 + mq**2 + 1e-4) * (vp + vq + 9e-4))
                )
    assert ssim(a, b) == pytest.approx(total / (9 * 12 * 3), abs=1e-12)


def test_metrics_refuse_images_of_different_shape_or_too_small():
    with pytest.raises((ValueError, TypeCheckError)):
        psnr(torch.zeros(4, 4, 3), torch.zeros(4, 5, 3))
    with pytest.raises(ValueError, match="at least 6 pixels"):
        ssim(torch.zeros(5, 9, 3), torch.zeros(5, 9, 3))


def patterned(height=24, width=31):
    y, x = torch.meshgrid(
        torch.arange(height),
        torch.arange(width),
        indexing="ij",
    )
    a = torch.stack(
        [(7 * x + 3 * y) % 256, (x * y) % 256, (11 * x + y * y) % 256],
        -1,
    )
    b = torch.stack(
        [(7 * x + 5 * y) % 256, (x * y + 9) % 256, (13 * x + y * y) % 256],
        -1,
    )
    return a.double() / 255, b.double() / 255


def test_ssim_as_released_is_that_of_torchmetrics_1_4():
    """torchmetrics 1.4.0, whose authors cut the border, and scikit-image 0.26.0 agree on these
    images:

    structural_similarity_index_measure(chw(a), chw(b), data_range=1.0)
    structural_similarity(a.numpy(), b.numpy(), channel_axis=2, gaussian_weights=True, sigma=1.5,
                          use_sample_covariance=False, data_range=1.0)
    """
    a, b = patterned()
    assert ssim_as_released(a, b) == pytest.approx(0.68686813212366, abs=1e-12)
    assert ssim(a, b) == pytest.approx(0.6793310, abs=1e-6)


class Network(torch.nn.Module):
    """Stands for AlexNet with LPIPS's weights: notes what it is given."""

    def forward(self, a, b):
        self.seen = a, b
        return (a - b).abs().mean()


def test_each_lpips_gives_the_network_its_own_images(monkeypatch):
    network = Network()
    monkeypatch.setattr(learned_distance, "_lpips_network", lambda: network)
    rgb = torch.zeros(8, 9, 3)
    other = torch.full((8, 9, 3), 1.0)
    rgb[..., 0] = 51 / 255  # red
    lpips(rgb, other)
    assert network.seen[0].shape == (1, 3, 8, 9)
    torch.testing.assert_close(
        network.seen[0][0, :, 0, 0],
        torch.tensor([-0.6, -1.0, -1.0]),
    )
    assert (network.seen[1] == 1).all()
    assert lpips_as_released(rgb, other) == pytest.approx((0.8 + 1 + 1) / 3)
    torch.testing.assert_close(
        network.seen[0][0, :, 0, 0],
        torch.tensor([0.0, 0.0, 0.2]),
    )


def test_depth_error_counts_only_pixels_with_both():
    ours = torch.tensor([[1.0, 0.0, 2.0, 3.0]])
    truth = torch.tensor([[1.5, 1.0, 0.0, 2.0]])
    l1, share = depth_l1_m(ours, truth)
    assert (l1, share) == (0.75, 0.5)
    l1, share = depth_l1_m(torch.zeros(2, 2), torch.ones(2, 2))
    assert math.isnan(l1)
    assert share == 0.0


def test_expected_depth_divides_by_alpha_and_drops_thin_pixels():
    index = torch.zeros(1, 3, dtype=torch.int64)
    view = RenderOutput(
        rgb=torch.zeros(1, 3, 3),
        depth_m=torch.tensor([[1.6, 0.4, 0.0]]),
        alpha=torch.tensor([[0.8, 0.2, 0.0]]),
        first_index=index,
        dominant_index=index,
    )
    assert torch.allclose(expected_depth_m(view), torch.tensor([[2.0, 0.0, 0.0]]))


def test_score_views_reads_frames_one_by_one(generator):
    alive = 0

    def frames():
        nonlocal alive
        for i in (3, 11):
            alive += 1
            yield frame_of(i, picture(generator), torch.full((24, 31), 2.0))
            alive -= 1

    def render(camera, T_WC):
        assert alive == 1
        return view_of(
            torch.full((24, 31, 3), 0.5),
            torch.full((24, 31), 2.1),
            alpha=0.9,
        )

    scores = score_views(render, frames())
    assert [row.index for row in scores.rows] == [3, 11]
    assert scores.psnr == pytest.approx(np.mean([row.psnr for row in scores.rows]))
    assert scores.depth_l1_m == pytest.approx(0.1, abs=1e-5)
    assert isinstance(scores.mean("lpips"), NotComputed)
    assert set(scores.as_metrics("held_out")) == {
        "psnr_held_out_db",
        "ssim_held_out",
        "lpips_held_out",
        "depth_l1_held_out_m",
        "ssim_as_released_held_out",
        "lpips_as_released_held_out",
    }


def test_score_views_of_no_frames_is_not_computed():
    scores = score_views(lambda camera, T_WC: None, [])  # pyright: ignore[reportArgumentType]
    assert scores.psnr == NotComputed("no view to score")
    assert metrics_as_json(scores.as_metrics("mapped"))["ssim_mapped"] == {
        "not_computed": "no view to score"
    }


def test_depth_mean_skips_views_without_common_depth(generator):
    rgb = picture(generator)
    frames = [frame_of(0, rgb, torch.zeros(24, 31)), frame_of(1, rgb, torch.ones(24, 31))]
    scores = score_views(
        lambda camera, T_WC: view_of(rgb, torch.full((24, 31), 1.5)),
        frames,
    )
    assert scores.depth_l1_m == pytest.approx(0.5)
    assert scores.psnr == math.inf


def test_a_view_with_a_nan_is_counted_and_its_frame_is_known(generator):
    """Otherwise a map that is broken in one view scores like one that is not."""
    rgb = picture(generator)
    broken = rgb.clone()
    broken[3, 4, 1] = math.nan
    frames = [frame_of(i, rgb, torch.ones(24, 31)) for i in (2, 5, 9)]
    renders = iter([rgb * 0.5, broken, rgb * 0.5])
    scores = score_views(
        lambda camera, T_WC: view_of(next(renders), torch.full((24, 31), 1.5)),
        frames,
    )
    assert scores.not_a_number == (5,)
    assert scores.without("ssim") == (5,)
    assert scores.without("depth_l1_m") == scores.without("lpips") == ()
    assert scores.psnr == pytest.approx(scores.rows[0].psnr)
    metrics = scores.as_metrics("held_out")
    assert metrics["n_views_nan_held_out"] == 1
    assert "n_views_no_depth_held_out" not in metrics
    assert format_metric("n_views_nan_held_out", 1.0) == "1"
    everywhere = score_views(
        lambda camera, T_WC: view_of(broken, torch.full((24, 31), 1.5)), frames
    )
    assert everywhere.psnr == everywhere.ssim == NotComputed("the render of every view has a NaN")


def test_a_view_without_a_depth_error_is_counted(generator):
    rgb = picture(generator)
    ones = torch.ones(24, 31)
    broken = torch.full((24, 31), 1.5)
    broken[0, 0] = math.nan
    assert math.isnan(depth_l1_m(broken, ones)[0])
    assert (
        depth_l1_m(
            broken,
            ones.index_put((torch.tensor(0), torch.tensor(0)), torch.tensor(0.0)),
        )[0]
        == 0.5
    )
    depths = iter([broken, torch.full((24, 31), 1.5), torch.full((24, 31), 1.5)])
    frames = [frame_of(0, rgb, ones), frame_of(1, rgb, torch.zeros(24, 31)), frame_of(2, rgb, ones)]
    scores = score_views(lambda camera, T_WC: view_of(rgb, next(depths)), frames)
    assert scores.without("depth_l1_m") == (0, 1)
    assert scores.depth_l1_m == pytest.approx(0.5)
    assert scores.as_metrics("mapped")["n_views_no_depth_mapped"] == 2


def test_scores_do_not_depend_on_the_number_of_threads():
    generator = torch.Generator().manual_seed(0)
    threads = torch.get_num_threads()
    rgb, other = (torch.rand(240, 320, 3, generator=generator) for _ in range(2))
    found = []
    try:
        for n in (1, 2, 3, 4):
            torch.set_num_threads(n)
            found.append((ssim(rgb, other), psnr(rgb, other)))
    finally:
        torch.set_num_threads(threads)
    assert len(set(found)) == 1


CAMERA = Camera(
    width=8,
    height=6,
    fx=8.0,
    fy=8.0,
    cx=4.0,
    cy=3.0,
)


def frame(depth_m=2.0):
    """A wall in front of the camera; the colour of a pixel says where it is."""
    row, column = torch.meshgrid(
        torch.arange(6) / 10,
        torch.arange(8) / 10,
        indexing="ij",
    )
    rgb = torch.stack([column, row, torch.full_like(row, 0.5)], dim=-1)
    return Frame(
        index=0,
        timestamp_s=0.0,
        rgb=rgb,
        depth_m=torch.full((6, 8), depth_m),
        camera=CAMERA,
        T_WC=torch.eye(4),
    )


def at(column, row, z_m, rgb):
    """A vertex behind the centre of a pixel."""
    return [(column + 0.5 - 4.0) / 8.0 * z_m, (row + 0.5 - 3.0) / 8.0 * z_m, z_m], rgb


def mesh_of(*vertices):
    return Mesh(
        vertices_W=torch.tensor([xyz for xyz, _ in vertices]),
        faces=torch.zeros(0, 3, dtype=torch.int64),
        rgb=torch.tensor([rgb for _, rgb in vertices]),
    )


def test_vertices_are_compared_with_their_pixels_and_hidden_ones_are_not():
    vertices = [
        at(3, 1, 2.0, [0.3, 0.1, 0.7]),  # blue is wrong by 0.2
        at(5, 4, 2.015, [0.5, 0.4, 0.5]),
        at(2, 2, 2.3, [1.0, 1.0, 1.0]),  # behind the wall
        at(2, 3, 1.7, [1.0, 1.0, 1.0]),  # nothing was seen there
        at(9, 2, 2.0, [1.0, 1.0, 1.0]),  # outside the picture
        at(2, 3, -2.0, [1.0, 1.0, 1.0]),  # behind the camera
    ]
    expected = -10 * torch.tensor(0.2**2 / 6).log10()
    assert mesh_psnr(mesh_of(*vertices), [frame()]) == pytest.approx(float(expected), abs=1e-3)
    assert mesh_psnr(mesh_of(*vertices), [frame(), frame(5.0)]) == pytest.approx(
        float(expected), abs=1e-3
    )


@pytest.mark.parametrize(
    ("name", "value", "text"),
    [
        ("psnr_held_out_db", 23.6789, "23.68\u00a0dB"),
        ("ssim_mapped", 0.81234, "0.812"),
        ("n_gaussians", 1234567, "1,234,567"),
        ("mesh_accuracy_m", 0.0123, "1.23\u00a0cm"),
        ("mesh_completion_ratio", 0.5, "50.0\u00a0%"),
        ("rpe_rotation_deg", 0.5, "0.500°"),
        ("psnr_mapped_db", math.inf, "∞\u00a0dB"),
        ("psnr_mapped_db", math.nan, "not computed: the result is not a number"),
        ("lpips_mapped", NotComputed("no weights"), "not computed: no weights"),
        ("lpips_mapped", {"not_computed": "no weights"}, "not computed: no weights"),
        ("n_keyframes", None, "not computed: not measured in this run"),
        ("something_new", 0.123456, "0.1235"),
        ("something_new", "text", "text"),
    ],
)
def test_format(name, value, text):
    assert format_metric(name, value) == text


def test_json_is_strict_and_comes_back():
    metrics = {"a": 1.5, "b": math.nan, "c": NotComputed("why"), "d": math.inf, "e": None}
    text = json.dumps(metrics_as_json(metrics), allow_nan=False)
    assert json.loads(text)["c"] == {"not_computed": "why"}
    assert format_metric("lpips_mapped", json.loads(text)["c"]) == "not computed: why"
    assert json.loads(text)["d"] == "infinite"


def test_both_frame_rates_by_hand():
    rates = frame_rates([0.1, 0.4])
    assert rates["fps_total"] == pytest.approx(4.0)
    assert rates["fps_mean_inverse"] == pytest.approx((10 + 2.5) / 2)
    assert isinstance(frame_rates([])["fps_total"], NotComputed)
    assert isinstance(frame_rates([0.1, 0.0])["fps_mean_inverse"], NotComputed)


UNITS = {
    "_db": ("dB", 1.0),
    "_m": ("cm", 100.0),
    "_mb": ("MB", 1.0),
    "_deg": ("°", 1.0),
    "fps_": ("frames/s", 1.0),
    "seconds_": ("s", 1.0),
    "n_": ("", 1.0),
    "ssim_": ("", 1.0),
    "lpips_": ("", 1.0),
    "_precision": ("%", 100.0),
    "_completion_ratio": ("%", 100.0),
    "_f_score": ("", 1.0),
    "_share": ("%", 100.0),
}
"""How a name begins or ends -> unit that is shown, and by what the number is multiplied for it."""


def test_a_metric_is_shown_in_the_unit_of_its_name():
    found = {}
    for name in METRICS:
        units = {of for part, of in UNITS.items() if name.startswith(part) or name.endswith(part)}
        number, *unit = format_metric(name, 0.25).replace("°", "\u00a0°").split("\u00a0")
        if units and unit != ["frames"]:  # a count of frames says so
            digits = len(number.partition(".")[2])
            [(wanted, factor)] = units
            found[name] = (
                "".join(unit) == wanted
                and abs(float(number) - 0.25 * factor) <= 0.501 * 10**-digits
            )
    assert len(found) > 50
    assert [name for name, fits in found.items() if not fits] == []


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (True, "yes"),
        (False, "no"),
        (12345, "12,345"),
        (0.000123456, "0.0001235"),
        ([1, 0.5, True], "1, 0.5, yes"),
        ("a", "a"),
    ],
)
def test_a_setting_as_text(value, text):
    assert format_value(value) == text
    assert format_metric("something_new", value) == text


@pytest.mark.parametrize(("side", "enough"), [(5, False), (6, True)])
def test_ssim_needs_half_a_window(side, enough):
    """11 x 11 pixels, of which five may be mirrored."""
    picture = torch.rand(
        side,
        20,
        3,
        generator=torch.Generator().manual_seed(0),
    )
    if enough:
        assert ssim(picture, picture) == pytest.approx(1.0)
    else:
        with pytest.raises(
            ValueError,
            match=r"at least 6 pixels high and wide for an 11x11 window, got \[5, 20, 3\]",
        ):
            ssim(picture, picture)
    [row] = score_views(
        lambda camera, T_WC: view_of(picture, torch.ones(side, 20)),
        [frame_of(0, picture, torch.ones(side, 20))],
    ).rows
    assert math.isnan(row.ssim) != enough


def test_psnr_clamps_to_the_data_range_and_leaves_inputs_alone():
    white = torch.ones(3, 3, 3)
    over = torch.full((3, 3, 3), 7.0)
    assert psnr(over, white) == math.inf
    assert over.max() == 7.0


def test_ssim_in_float32_agrees_with_float64(generator):
    a = picture(generator, 40, 50)
    b = picture(generator, 40, 50)
    assert ssim(a, b) == pytest.approx(ssim(a.double(), b.double()), abs=1e-5)


def test_ssim_as_released_does_not_see_the_border(generator):
    """A pixel of the border counts only in windows that reach it, and those are around pixels
    nearer than 6."""
    a, b = patterned()
    inner = ssim_as_released(a, b)
    assert (
        ssim_as_released(
            a[5:-5, 5:-5],
            b[5:-5, 5:-5],
        )
        != inner
    )
    with pytest.raises(ValueError, match="at least 11 pixels"):
        ssim_as_released(torch.zeros(10, 30, 3), torch.zeros(10, 30, 3))


@pytest.fixture
def no_cached_network():
    learned_distance._lpips_network.cache_clear()
    yield
    learned_distance._lpips_network.cache_clear()


def test_lpips_without_its_package_says_so(monkeypatch, no_cached_network):
    monkeypatch.setitem(sys.modules, "lpips", None)
    result = lpips(torch.zeros(8, 8, 3), torch.zeros(8, 8, 3))
    assert isinstance(result, NotComputed)
    assert lpips_as_released(torch.zeros(8, 8, 3), torch.zeros(8, 8, 3)) == result
    assert str(result).startswith("not computed: package 'lpips' is not installed")


def test_lpips_without_weights_says_so_and_never_builds_the_network(
    monkeypatch, no_cached_network, tmp_path
):
    """A stand-in package: building the network would mean a download, so it must not happen."""

    class Package:
        @staticmethod
        def LPIPS(**_):
            raise AssertionError("this would download")

    class Models:
        class AlexNet_Weights:
            class IMAGENET1K_V1:
                url = "https://example.org/alexnet-owt-7be5be79.pth"

    monkeypatch.setitem(sys.modules, "lpips", Package)
    monkeypatch.setitem(sys.modules, "torchvision", Models)
    monkeypatch.setitem(sys.modules, "torchvision.models", Models)
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    result = lpips(torch.zeros(8, 8, 3), torch.zeros(8, 8, 3))
    assert isinstance(result, NotComputed)
    assert "alexnet-owt-7be5be79.pth" in result.reason


def test_no_number_if_no_view_shows_the_mesh():
    assert mesh_psnr(
        mesh_of(at(3, 1, 2.0, [0.5] * 3)),
        [frame(5.0)],
    ) == NotComputed("no view shows a vertex of the mesh")


@pytest.mark.parametrize(("side", "enough"), [(10, False), (11, True)])
def test_a_score_without_its_border_needs_a_picture_that_is_larger(side, enough):
    """Five pixels are left out on each side."""
    picture = torch.rand(
        side,
        20,
        3,
        generator=torch.Generator().manual_seed(0),
    )
    frames = [frame_of(0, picture, torch.ones(side, 20))]
    [row] = score_views(lambda camera, T_WC: view_of(picture, torch.ones(side, 20)), frames).rows
    assert math.isnan(row.ssim_as_released) != enough
