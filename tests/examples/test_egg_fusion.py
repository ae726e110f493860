"""The EGG-Fusion package of docs/examples: its filter by hand-made values, its pictures, and the
commands that know it by its entry point."""

import dataclasses
import json
from pathlib import Path

import pytest
import torch
from egg_fusion import EggFusion, SurfelState, egg_insertion, fused
from egg_fusion.mapper import smoothed
from egg_fusion.picture import draw
from egg_fusion.surfel_filter import information, normals_of, turned
from egg_package import write_metadata

from gsfusion_nb.cli import main
from gsfusion_nb.data.room import room
from gsfusion_nb.errors import ArgumentError
from gsfusion_nb.gaussians import GaussianModel
from gsfusion_nb.geometry.quaternion import from_matrix
from gsfusion_nb.mapping import system_names, systems
from gsfusion_nb.seeding import check_rule, registered
from gsfusion_nb.seeding.discs import quat_from_normals
from gsfusion_nb.seeding.rule import keep_registered
from gsfusion_nb.types import Camera, Frame, Seeds


def state(p, n, w_p, w_n):
    values = (torch.tensor([x], dtype=torch.float64) for x in (p, n, w_p, w_n))
    return SurfelState(**dict(zip(("xyz_W", "normal_W", "w_p", "w_n"), values, strict=True)))


def seen(old, point, normal, depth_m, **alphas):
    values = (torch.tensor([x], dtype=torch.float64) for x in (point, normal, depth_m))
    return fused(old, *values, **alphas)


def test_an_observation_is_weighed_by_its_depth():
    old = state([0.0, 0.0, 1.99], [0.0, 0.0, -1.0], 1.0, 4.0)
    new = seen(old, [0.0, 0.0, 2.0], [0.0, 0.6, -0.8], 2.0, alpha_p=1.0, alpha_n=0.5)
    assert new.xyz_W[0].tolist() == pytest.approx([0, 0, 1.992])
    assert new.normal_W[0].tolist() == pytest.approx([0, 0.124034735, -0.992277877])
    assert (float(new.w_p), float(new.w_n)) == pytest.approx((1.25, 5.0))


def test_the_position_of_the_camera_is_taken_off():
    R_WC = torch.tensor([[0, 0, 1], [0, 1, 0], [-1, 0, 0]], dtype=torch.float64)
    t = torch.tensor([0.1, -0.2, 0.3], dtype=torch.float64)
    point = (R_WC @ (torch.tensor([0.2, 0, 2.02], dtype=torch.float64) - t)).tolist()
    old = state([1.7, 0.2, -0.1], [1.0, 0.0, 0.0], 0.25, 1.0)
    new = seen(old, point, [1.0, 0.0, 0.0], 2.02, alpha_p=1.0, alpha_n=0.5)
    assert new.xyz_W[0].tolist() == pytest.approx([1.7099005, 0.2, -0.1])
    assert (float(new.w_p), float(new.w_n)) == pytest.approx((0.495074012, 1.980296049))


@pytest.mark.parametrize(("depth_m", "views"), [(0.5, 1), (1.0, 3), (2.0, 9), (3.0, 19)])
def test_how_many_views_make_a_surfel_stable(depth_m, views):
    d = torch.tensor([depth_m], dtype=torch.float64)
    w = float(information(d, 1.0) + information(d, 0.5))
    assert (views - 1) * w <= 10 + 1e-9 < views * w


def test_a_surfel_turns_with_its_normal():
    before = torch.tensor([[0.0, 0.0, -1.0], [0.0, 0.0, 1.0], [0.0, 0.0, -1.0]])
    after = torch.nn.functional.normalize(
        torch.tensor([[0.0, 0.12, -0.96], [0.0, 0.0, 1.0], [0.6, 0.0, -0.8]]), dim=1
    )
    quat = quat_from_normals(before)
    now = turned(quat, before, after)
    torch.testing.assert_close(normals_of(now), after, atol=1e-6, rtol=0)
    assert torch.equal(now[1], quat[1])
    angle = 2 * torch.acos((now[0] * quat[0]).sum().clamp(max=1)).rad2deg()
    assert float(angle) == pytest.approx(7.125016, abs=1e-3)
    assert from_matrix(torch.eye(3)).shape == (4,)


def test_a_tilted_plane_is_drawn_at_its_depth():
    normal = torch.nn.functional.normalize(torch.tensor([[0.3, -0.2, -0.9]]), dim=1)
    model = GaussianModel(sh_degree=0)
    centre = torch.tensor([[0.0, 0.0, 2.0]])
    discs = Seeds.isotropic(centre, torch.ones(1, 3), torch.tensor([0.3]), opacity=0.99)
    flat_m = torch.tensor([[0.3, 0.3, 0.003]])
    model.append(dataclasses.replace(discs, quat=quat_from_normals(normal), scale_m=flat_m))
    camera = Camera(width=40, height=30, fx=40.0, fy=40.0, cx=20.0, cy=15.0)
    picture = draw(model.params, camera, torch.eye(4))
    shown = picture.depth_m > 0
    assert shown.sum() > 50
    v, u = shown.nonzero().unbind(1)
    r = torch.stack([(u + 0.5 - 20) / 40, (v + 0.5 - 15) / 40, torch.ones(len(u))], dim=1)
    plane_m = (normal @ centre.T) / (r @ normal.T)
    torch.testing.assert_close(picture.depth_m[shown], plane_m[:, 0], rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(picture.normal_W[shown], normal.expand(len(u), 3), atol=1e-5, rtol=0)


SIZE = {"data__width": 64, "data__height": 48, "final_passes": 1, "first_steps": 4}


def frame(index: int) -> Frame:
    return room(n_frames=480, width=64, height=48)[index]


def test_noise_is_filtered():
    mapper = EggFusion(EggFusion.preset("room", round_steps=0, **SIZE))
    clean = room(n_frames=480, width=64, height=48)[0]
    generator = torch.Generator().manual_seed(0)
    errors_m = []
    for index in range(8):
        noise_m = 0.02 * torch.randn(48, 64, generator=generator)
        noisy_m = torch.where(clean.depth_m > 0, clean.depth_m + noise_m, 0.0)
        report = mapper.step(dataclasses.replace(clean, index=index, depth_m=noisy_m))
        depth_m = mapper.surface(clean.camera, clean.T_WC).depth_m
        both = (depth_m > 0) & (clean.depth_m > 0)
        errors_m.append(float((depth_m - clean.depth_m).abs()[both].median()))
    assert errors_m[-1] < 0.8 * errors_m[0]
    assert report.counts["fused"] > 200
    assert report.counts["stable"] > 0
    assert float(mapper.w_p.max()) > 4 * float(mapper.w_p.min())


def test_a_frame_of_which_nothing_can_be_used_changes_nothing():
    mapper = EggFusion(EggFusion.preset("room", **SIZE))
    mapper.step(frame(0))
    before = mapper.state_dict()
    xyz_W = mapper.gaussians.params.xyz_W.clone()
    with pytest.raises(ValueError, match="depth"):
        mapper.step(dataclasses.replace(frame(1), depth_m=torch.zeros(48, 64)))
    assert torch.equal(mapper.gaussians.params.xyz_W, xyz_W)
    again = EggFusion.from_state_dict(before)
    again.step(frame(2))
    mapper.step(frame(2))
    assert torch.equal(again.w_p, mapper.w_p)
    assert torch.equal(again.gaussians.params.xyz_W, mapper.gaussians.params.xyz_W)
    with pytest.raises(ArgumentError, match="has its own loss"):
        EggFusion(EggFusion.preset("room"), loss=lambda picture, view: None)


def test_missing_depth_stays_missing():
    depth_m = torch.full((48, 64), 2.0)
    depth_m[::5, ::3] = 0.0
    holes = dataclasses.replace(frame(0), depth_m=depth_m)
    smooth = smoothed(holes).depth_m
    assert torch.equal(smooth > 0, holes.depth_m > 0)
    assert float(smooth[smooth > 0].min()) > 1.9


def test_its_rule_is_one():
    with keep_registered():
        check_rule(egg_insertion)


@pytest.fixture
def installed(tmp_path, monkeypatch):
    """The package as pip leaves it: its metadata on Python's path."""
    monkeypatch.syspath_prepend(str(write_metadata(tmp_path / "site")))
    monkeypatch.setattr(systems, "_NAMES", dict(systems._NAMES))
    monkeypatch.setattr(systems, "_REGISTERED", dict(systems._REGISTERED))
    with keep_registered():
        yield


@pytest.mark.ci
@pytest.mark.usefixtures("installed")
def test_map_and_eval_as_a_user_types_them(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert "egg_fusion" in system_names()
    typed = ["map", "room", "--system", "egg_fusion", "--out", "run", "--reader", "n_frames=480"]
    typed += [
        "--data.width",
        "64",
        "--data.height",
        "48",
        "--data.stop",
        "5",
        "--final-passes",
        "1",
    ]
    few = ["--final-passes", "1", "--round-steps", "3", "--first-steps", "3"]
    assert main([*typed, *few]) == 0
    about = json.loads(Path("run/config.json").read_text())
    assert (about["system"], about["system_package"]) == ("egg_fusion", "egg-fusion-example 0.1.0")
    assert about["rule"] == "egg_insertion"
    assert "egg_insertion" in registered()
    scores = json.loads(Path("run/metrics.json").read_text())["metrics"]
    assert scores["psnr_held_out_db"] > 12
    assert main(["eval", "run"]) == 0
    assert json.loads(Path("run/metrics.json").read_text())["metrics"] == scores
