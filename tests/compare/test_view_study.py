"""Views that a map was made of and others: how a walk is split, what belongs to a frame, and that
Gaussians that belong to a frame store its picture."""

import copy
import csv
import dataclasses
import json
from typing import Any, cast

import pytest
import torch

from gsfusion_nb.cli import main as cli
from gsfusion_nb.compare import compare_views
from gsfusion_nb.compare.frame_owned import (
    FrameOwnedMap,
    FrameOwnedSettings,
    joined,
    pixel_seeds,
    train_step,
    without_holes,
)
from gsfusion_nb.compare.view_study import ONE_MAP, OWN_SETS, WAYS
from gsfusion_nb.compare.walk_split import WalkSplit, pose_distance
from gsfusion_nb.config import DataConfig
from gsfusion_nb.data import open_sequence
from gsfusion_nb.evaluation import score_views
from gsfusion_nb.gaussians import GaussianModel
from gsfusion_nb.geometry import se3
from gsfusion_nb.render import render_forward
from gsfusion_nb.types import Camera, Frame

CAMERA = Camera(width=24, height=18, fx=20.0, fy=20.0, cx=12.0, cy=9.0)


def walk(n_frames: int = 40, **data):
    return open_sequence("room", data=DataConfig(width=24, height=18, **data), n_frames=n_frames)


def wall(index: int = 0, x_m: float = 0.0) -> Frame:
    """A wall at 2 m of tiles of 3 x 3 pixels in random colours, seen from ``x_m``."""
    T_WC = torch.eye(4)
    T_WC[0, 3] = x_m
    tiles = torch.rand(6, 8, 3, generator=torch.Generator().manual_seed(index))
    colours = tiles.repeat_interleave(3, 0).repeat_interleave(3, 1)
    return Frame(
        index=index,
        camera=CAMERA,
        colour=colours,
        depth_m=torch.full((18, 24), 2.0),
        T_WC=T_WC,
        timestamp_s=float(index),
    )


def psnr_db(owned: FrameOwnedMap, frame: Frame) -> float:
    return score_views(owned.render, [frame]).rows[0].psnr


def test_a_walk_is_split_by_its_frames():
    """Of 40 frames, two stretches of a tenth are far; of the rest every 8th is held out."""
    split = WalkSplit.of(walk(hold_out_every=8))
    assert split.far == [12, 13, 14, 15, 26, 27, 28, 29]
    assert split.sequence.held_out.positions == [4, 20, 36]
    mapped = split.sequence.mapping.positions
    assert sorted([*mapped, *split.far, 4, 20, 36]) == list(range(40))
    assert split.views() == {"mapped": mapped, "between": [4, 20, 36], "far": split.far}
    assert [f.index for f in split.frames(split.far[:2])] == [12, 13]


def test_a_walk_that_cannot_be_split_is_refused():
    with pytest.raises(ValueError, match=r"at least 20 frames.*has 19"):
        WalkSplit.of(walk(19))
    with pytest.raises(ValueError, match=r"set data\.hold_out_every"):
        WalkSplit.of(walk(hold_out_every=0))


def test_published_test_views_are_far():
    sequence = walk(hold_out_every=8)
    source: Any = copy.copy(sequence.source)
    object.__setattr__(source, "novel", frozenset({38, 39}))
    positions = [p for p in sequence.mapping.positions if p < 38]
    held_out = [*sequence.held_out.positions, 38, 39]
    split = WalkSplit.of(
        dataclasses.replace(
            sequence,
            source=source,
            mapping=dataclasses.replace(sequence.mapping, positions=positions),
            held_out=dataclasses.replace(sequence.held_out, positions=held_out),
        )
    )
    assert {38, 39} <= set(split.far)
    assert not {38, 39} & {*split.sequence.mapping.positions, *split.sequence.held_out.positions}


def test_distance_of_poses_by_hand():
    """3 cm and a quarter turn: 0.03 + pi / 2."""
    T = se3.exp(torch.tensor([0.0, 0.0, 0.0, 0.0, torch.pi / 2, 0.0]))
    T[0, 3] = 0.03
    assert pose_distance(torch.eye(4), T) == pytest.approx(0.03 + torch.pi / 2, abs=1e-5)


def test_a_gaussian_for_each_pixel_by_hand():
    """Pixel (0, 0) of the wall: ray ((0.5 - 12) / 20, (0.5 - 9) / 20, 1) times 2 m, radius 2 m /
    20 px."""
    seeds = pixel_seeds(wall(x_m=1.0), FrameOwnedSettings())
    assert len(seeds) == 24 * 18
    torch.testing.assert_close(seeds.xyz_W[0], torch.tensor([1 - 1.15, -0.85, 2.0]))
    torch.testing.assert_close(seeds.scale_m[0], torch.full((3,), 0.1))
    torch.testing.assert_close(seeds.rgb[0], wall(x_m=1.0).rgb[0, 0])
    coarse = pixel_seeds(wall(), FrameOwnedSettings(stride_px=3))
    assert len(coarse) == 8 * 6
    torch.testing.assert_close(coarse.scale_m[0], torch.full((3,), 0.3))
    torch.testing.assert_close(coarse.rgb[0], wall().rgb[1, 1])


def test_holes_of_the_depth_are_filled_and_the_rest_stays():
    depth_m = torch.full((18, 24), 2.0)
    depth_m[4:8, 5:9] = 0
    depth_m[:, 20:] = 0
    filled = without_holes(depth_m)
    torch.testing.assert_close(filled, torch.full((18, 24), 2.0), atol=1e-3, rtol=0)


def test_a_frame_stores_its_picture_and_its_set_stays():
    """Noise, which no map could show from elsewhere: the own set shows it, the nearest frame's does
    not. A later frame leaves earlier sets as they are."""
    owned = FrameOwnedMap(FrameOwnedSettings(steps=60))
    first, second = wall(0), wall(1, x_m=5.0)
    owned.add(first)
    before = {name: x.clone() for name, x in vars(owned.sets[0].model.params).items()}
    owned.add(second)
    for name, values in before.items():
        assert torch.equal(getattr(owned.sets[0].model.params, name), values), name
    start = pixel_seeds(first, FrameOwnedSettings())
    params = owned.sets[0].model.params
    assert torch.equal(params.xyz_W, start.xyz_W)
    assert torch.equal(params.log_scale[:, 0], params.log_scale[:, 1])
    assert not torch.allclose(params.log_scale[:, 0].exp(), start.scale_m[:, 0])
    untrained = FrameOwnedMap(FrameOwnedSettings(steps=0))
    untrained.add(first)
    assert psnr_db(owned, first) > psnr_db(untrained, first) + 4
    assert owned.nearest(torch.eye(4)) == 0
    assert owned.nearest(second.T_WC) == 1
    other = dataclasses.replace(wall(7), T_WC=second.T_WC)
    assert psnr_db(owned, other) < psnr_db(owned, second) - 4


def test_a_view_shows_the_nearest_set_and_two_before_it():
    owned = FrameOwnedMap(FrameOwnedSettings(steps=0))
    frames = [wall(i, x_m=0.2 * i) for i in range(5)]
    assert [owned.add(frame).index for frame in frames] == [0, 1, 2, 3, 4]
    shown = owned.render(CAMERA, frames[3].T_WC)
    by_hand = joined([owned.sets[i].model.params for i in (1, 2, 3)])
    assert torch.equal(shown.rgb, render_forward(by_hand, CAMERA, frames[3].T_WC)[0].rgb)
    merged = owned.merged()
    assert len(merged) == len(owned) == 5 * 24 * 18
    assert torch.equal(merged.params.xyz_W[: 24 * 18], owned.sets[0].model.params.xyz_W)


def test_frozen_gaussians_do_not_learn():
    model = GaussianModel(sh_degree=0)
    model.append(pixel_seeds(wall(), FrameOwnedSettings()))
    frozen = GaussianModel(sh_degree=0)
    frozen.append(pixel_seeds(wall(2, x_m=0.3), FrameOwnedSettings()))
    before = {name: x.clone() for name, x in vars(frozen.params).items()}
    colours = model.params.sh.clone()
    train_step(model, wall(), [frozen.params])
    assert not torch.equal(model.params.sh, colours)
    assert all(torch.equal(getattr(frozen.params, name), x) for name, x in before.items())


def test_settings_out_of_range_are_refused():
    for bad in ({"stride_px": 0}, {"steps": -1}, {"opacity": 1.5}):
        with pytest.raises(ValueError, match=next(iter(bad))):
            FrameOwnedSettings(**cast(Any, bad))


def test_the_comparison_from_python():
    """The same numbers as the command's, and a name that is refused."""
    settings = ("data.width=24", "data.height=18")
    views = compare_views(ways=[ONE_MAP], settings=settings, reader=("n_frames=20",))
    (way,) = views.scores
    assert way.label == ONE_MAP
    assert way.n_gaussians == 14 * 24 * 18
    assert f"{way.psnr_db['far']:.2f} dB far" in repr(views)
    assert len(views.figure().axes) == 4
    with pytest.raises(KeyError, match="frame-owmed"):
        compare_views(ways=["frame-owmed"])


def test_the_command_shows_the_inflation(tmp_path, capsys):
    """On a short walk the own sets win on mapped views and lose far from them; files and pictures
    are written."""
    arguments = ["study", "views", "room", "--reader", "n_frames=20", "--out", str(tmp_path)]
    settings = ["data.width=24", "data.height=18"]
    assert cli([*arguments, "--only", "frame-owned", "--set", *settings]) == 0
    text = (tmp_path / "views.csv").read_text(encoding="utf-8")
    rows = {row["map"]: row for row in csv.DictReader(text.splitlines())}
    assert list(rows) == list(WAYS[3:])
    own = {group: float(rows[OWN_SETS][f"psnr_{group}_db"]) for group in ("mapped", "far")}
    one = {group: float(rows[WAYS[4]][f"psnr_{group}_db"]) for group in ("mapped", "far")}
    assert own["mapped"] > one["mapped"] + 2
    assert own["mapped"] - own["far"] > one["mapped"] - one["far"] + 4
    assert "| frame-owned |" in (tmp_path / "table.md").read_text(encoding="utf-8")
    records = json.loads((tmp_path / "table.json").read_text(encoding="utf-8"))
    assert records[OWN_SETS]["inflation_db"] == pytest.approx(own["mapped"] - own["far"])
    assert (tmp_path / "views.png").read_bytes().startswith(b"\x89PNG")
    out = capsys.readouterr().out
    assert "14 frames mapped; 2 views between" in out
    assert cli([*arguments, "--only", "nothing"]) == 1
    assert "no way's name contains 'nothing'" in capsys.readouterr().err
    assert cli([*arguments, "--jobs", "2"]) == 1
    assert "leave out --jobs and --dask" in capsys.readouterr().err
