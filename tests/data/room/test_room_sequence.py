"""The room as a sequence: interface, cache, noise, paths, coverage, mesh; the mistakes of a
hand-held recording that it can be given, with the truth known."""

from typing import Any

import numpy as np
import pytest
import torch

from gsfusion_nb.data.room import kinect_depth, render_room, room, room_mesh, room_sdf
from gsfusion_nb.data.room.camera import walk
from gsfusion_nb.data.room.depth_noise import DISPARITY_STEP_PX, FOCAL_BASELINE_PX_M
from gsfusion_nb.data.room.scene import load_scene
from gsfusion_nb.files import cache_folder
from gsfusion_nb.geometry import backproject, depth_to_points, pixel_grid, se3
from gsfusion_nb.types import Camera

SMALL: dict[str, Any] = {"width": 80, "height": 60}


@pytest.fixture(autouse=True, scope="module")
def _textures():
    """The textures, from the cache of the session; a test with a cache of its own would paint them
    again."""
    load_scene(0)


@pytest.mark.parametrize(
    "option",
    [
        {"n_frames": 0},
        {"width": 4},
        {"seed": -1},
        {"trajectory": "up"},
        {"noise": "gauss"},
        {"holes": 2.0},
    ],
)
def test_wrong_options_are_named(option):
    with pytest.raises(ValueError, match=next(iter(option))):
        room(**option)


def test_cache_gives_the_same_frame_and_recovers_from_damage(monkeypatch, tmp_path):
    monkeypatch.setenv("GSFUSION_CACHE", str(tmp_path))
    sequence = room(n_frames=9, **SMALL)
    fresh = sequence[4]
    (path,) = (cache_folder() / "room").glob("room-80x60-*/000004.npz")
    for damage in (None, b"", path.read_bytes()[:500], b"PK" + bytes(2000)):
        if damage is not None:
            path.write_bytes(damage)
        again = sequence[4]
        assert torch.equal(again.rgb, fresh.rgb)
        assert torch.equal(again.depth_m, fresh.depth_m)
    assert not list(path.parent.glob(".*"))
    rgb, depth_m = render_room(sequence.camera, sequence.pose(4))
    assert (fresh.depth_m - depth_m).abs().max() < 0.6e-4  # steps of 0.1 mm
    assert (fresh.rgb - rgb).abs().max() < 0.51 / 255


def test_noise_grows_with_the_square_of_depth_and_is_quantised():
    camera = Camera(
        width=320,
        height=240,
        fx=208.0,
        fy=208.0,
        cx=160.0,
        cy=120.0,
    )
    sigma = {}
    for z in (1.0, 2.0, 4.0):
        measured = kinect_depth(
            torch.full((240, 320), z),
            camera,
            rng=np.random.default_rng(0),
        )
        seen = measured[measured > 0]
        steps = FOCAL_BASELINE_PX_M / seen.double() / DISPARITY_STEP_PX
        assert (steps - steps.round()).abs().max() < 1e-3
        assert 0.97 < len(seen) / measured.numel() < 1
        assert abs(float(seen.mean()) - z) < 0.2 * FOCAL_BASELINE_PX_M / 64 * 1e-2 * z**2
        sigma[z] = float(seen.double().sub(z).square().mean().sqrt())
    assert 1.2e-3 < sigma[1.0] < 2.2e-3  # Khoshelham & Elberink: 1.4e-3 to 1.6e-3 z^2
    assert 3.0 < sigma[2.0] / sigma[1.0] < 5.0
    assert 3.0 < sigma[4.0] / sigma[2.0] < 5.0


def test_noise_makes_holes_where_a_kinect_has_them():
    clean, noisy = (
        room(n_frames=20, noise=n, width=320, height=240)[9] for n in ("none", "kinect")
    )
    hole = noisy.depth_m == 0
    assert (clean.depth_m > 0).all()
    assert torch.equal(clean.rgb, noisy.rgb)
    assert 0.01 < hole.double().mean() < 0.3
    jump = torch.zeros_like(hole)
    jump[:, 1:] = (clean.depth_m[:, 1:] - clean.depth_m[:, :-1]).abs() > 0.15
    assert hole[jump].double().mean() > 2 * hole[~jump].double().mean()
    again = room(n_frames=20, noise="kinect", width=320, height=240)[9]
    assert torch.equal(again.depth_m, noisy.depth_m)
    camera = Camera(
        width=32,
        height=24,
        fx=20.0,
        fy=20.0,
        cx=16.0,
        cy=12.0,
    )
    for z in (0.2, 6.0):
        assert (
            kinect_depth(
                torch.full((24, 32), z),
                camera,
                rng=np.random.default_rng(0),
            )
            == 0
        ).all()


@pytest.mark.parametrize("trajectory", ["mapping", "novel"])
def test_walks_keep_clear_of_things_and_are_calm(trajectory):
    sequence = room(trajectory=trajectory, n_frames=500)
    T_WC = torch.stack([sequence.pose(i) for i in range(500)]).double()
    assert room_sdf(T_WC[:, :3, 3]).min() > 0.4
    times = sequence.times_s
    speed = T_WC[:, :3, 3].diff(dim=0).norm(dim=1) / np.diff(times)[0]
    turn = (
        torch.rad2deg((T_WC[1:, :3, 2] * T_WC[:-1, :3, 2]).sum(1).clamp(-1, 1).acos())
        / np.diff(times)[0]
    )
    assert speed.max() < 1.0
    assert 0.2 < speed.mean() < 0.6
    assert turn.max() < 90
    R = T_WC[:, :3, :3]
    torch.testing.assert_close(
        R @ R.mT,
        torch.eye(3, dtype=R.dtype).expand_as(R),
        atol=1e-6,
        rtol=0,
    )
    assert (R[:, 2, 1] < 0).all()  # the image's down is the world's down


def test_mesh_lies_on_the_surface_and_faces_the_free_side():
    mesh = room_mesh(0.08)
    assert room_sdf(mesh.vertices_W.double()).abs().max() < 1e-3
    assert mesh.faces.max() + 1 == len(mesh.vertices_W) == len(mesh.rgb)
    xyz = mesh.vertices_W.double()[mesh.faces]
    cross = torch.linalg.cross(
        xyz[:, 1] - xyz[:, 0],
        xyz[:, 2] - xyz[:, 0],
    )
    large = cross.norm(dim=1) > 1e-4
    normal = cross[large] / cross[large].norm(dim=1, keepdim=True)
    centre = xyz[large].mean(1)
    ahead = room_sdf(centre + 0.004 * normal)
    behind = room_sdf(centre - 0.004 * normal)
    assert (ahead > behind).double().mean() > 0.99
    assert mesh.rgb.std() > 0.1


WALK: dict[str, Any] = {"n_frames": 200, **SMALL}


def twists(sequence):
    """log(true^-1 given) of every frame, metres and radians. [n, 6]"""
    pairs = [
        (sequence.true_pose(i).double(), sequence.pose(i).double()) for i in range(len(sequence))
    ]
    return torch.stack([se3.log(se3.inverse(true) @ given) for true, given in pairs])


def test_poses_wander_about_the_truth_by_the_given_deviation():
    clean = room(**WALK)
    off = room(**WALK, pose_error_m=0.01, pose_error_deg=0.5)
    assert torch.equal(off.true_pose(7), clean.pose(7))
    assert torch.equal(off[7].T_WC, off.pose(7))
    # what the cache would store
    pictures = [sequence._render(7)["rgb"] for sequence in (off, clean)]
    assert (pictures[0] == pictures[1]).all()
    xi = twists(off)
    assert xi[:, :3].std().item() == pytest.approx(0.01, rel=0.2)
    assert xi[:, 3:].std().rad2deg().item() == pytest.approx(0.5, rel=0.2)
    # white noise: 1.4 times
    assert (xi[1:] - xi[:-1]).norm(dim=1).median() < xi.norm(dim=1).median()


def test_a_delay_gives_each_image_a_later_pose():
    later = room(**WALK, pose_delay_s=0.5)
    times = later.times_s
    step_s = float(times[1] - times[0])
    # a frame about every 0.05 s
    fine = room(n_frames=1 + round(199 * step_s / 0.05), width=80, height=60)
    i = 40
    expected = walk("mapping", 200, 0, delay_s=0.5)[0][i]
    torch.testing.assert_close(
        later.pose(i).double(),
        torch.from_numpy(expected),
        atol=1e-6,
        rtol=0,
    )
    nearest = fine.pose(round((float(times[i]) + 0.5) / float(fine.times_s[1])))
    assert (later.pose(i)[:3, 3] - nearest[:3, 3]).norm() < 0.03
    assert later.times_s[i] == times[i]


def test_exposure_multiplies_the_colours_and_is_one_on_average():
    clean = room(**WALK)
    wandering = room(**WALK, exposure_stops=0.4)
    ratios = []
    for i in range(0, 200, 20):
        a = clean[i].rgb
        b = wandering[i].rgb
        used = (a > 0.2) & (b < 0.98)
        gain = torch.stack(
            [(b[..., c][used[..., c]] / a[..., c][used[..., c]]).median() for c in range(3)]
        )
        assert ((a * gain).clamp(max=1) - b).abs().max() < 0.03
        ratios.append(gain.log2() * 2.2)
    assert torch.stack(ratios).mean(1).std().item() == pytest.approx(0.4, rel=0.5)


def test_holes_belong_to_surfaces_and_not_to_views():
    clean = room(**WALK)
    holed = room(**WALK, holes=0.3)
    a = clean[50].depth_m
    b = holed[50].depth_m
    assert torch.equal(b[b > 0], a[b > 0])
    assert 0.15 < float((b == 0).float().mean()) < 0.5
    # a point without depth has none in the next view, either
    camera = clean.camera
    T = clean.pose(50)
    lost = se3.apply(T, backproject(camera, pixel_grid(camera), a))[(b == 0)]
    x = se3.apply(se3.inverse(clean.pose(51)), lost)
    u = camera.fx * x[:, 0] / x[:, 2] + camera.cx
    v = camera.fy * x[:, 1] / x[:, 2] + camera.cy
    inside = (u >= 0) & (u < 80) & (v >= 0) & (v < 60)
    i = u[inside].long()
    j = v[inside].long()
    visible = (clean[51].depth_m[j, i] - x[inside, 2]).abs() < 0.02
    assert (holed[51].depth_m[j, i][visible] == 0).float().mean() > 0.7


def test_a_building_has_the_same_room_in_each_place():
    one, building = (room(n_frames=3, rooms=n, width=32, height=24) for n in (1, 5))
    assert len(building) == 15
    for i in range(15):
        here = one[i % 3]
        there = building[i]
        n = i // 3
        assert torch.equal(there.colour, here.colour)
        assert torch.equal(there.depth_m, here.depth_m)
        moved_m = there.T_WC[:3, 3] - here.T_WC[:3, 3]
        assert moved_m.tolist() == pytest.approx(
            [10 * (n % 3), 10 * (n // 3), 0],
            abs=1e-5,
        )
    assert bool((np.diff(building.times_s) > 0).all())
    mesh = building.mesh()
    of_one = one.mesh()
    assert len(mesh.faces) == 5 * len(of_one.faces)
    assert float(mesh.vertices_W[:, 0].max() - of_one.vertices_W[:, 0].max()) == pytest.approx(
        20, abs=1e-4
    )


def test_unwritable_cache_is_no_error(monkeypatch, tmp_path):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("GSFUSION_CACHE", str(tmp_path / "file"))
    assert room(n_frames=2, **SMALL)[0].depth_m.min() > 0


def test_mesh_colours_match_the_rendered_view():
    mesh = room_mesh(0.08)
    frame = room(n_frames=9, width=160, height=120)[4]
    points = se3.apply(frame.T_WC, depth_to_points(frame.camera, frame.depth_m))[
        ::10, ::10
    ].reshape(-1, 3)
    nearest = torch.cdist(points, mesh.vertices_W).argmin(1)
    difference = (mesh.rgb[nearest] - frame.rgb[::10, ::10].reshape(-1, 3)).abs().mean(1)
    assert difference.median() < 0.06
