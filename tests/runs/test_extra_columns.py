"""What each Gaussian shows of the frames' further images."""

import dataclasses
import json
import math
import shutil
from typing import Any

import numpy as np
import pytest
import torch
from three_gaussians import three_gaussians

from gsfusion_nb.backends import use_backend
from gsfusion_nb.cli import main
from gsfusion_nb.config import gps_slam, gsfusion
from gsfusion_nb.data import open_sequence
from gsfusion_nb.errors import ArgumentError, KindError
from gsfusion_nb.export import read_gaussian_ply
from gsfusion_nb.geometry import se3
from gsfusion_nb.render import render_autograd
from gsfusion_nb.runs import extra_columns as module
from gsfusion_nb.runs import run_mapping
from gsfusion_nb.runs.extra_columns import extra_columns
from gsfusion_nb.types import Frame

LEFT, RIGHT = 3, 700
"""Labels of the two parts of the wall."""


@pytest.fixture
def map_of_three():
    return three_gaussians(torch.float32)


@pytest.fixture
def frames(map_of_three, generator):
    """Two views of three Gaussians with labels, truth values and two kinds of numbers."""
    camera = map_of_three.camera
    size = (camera.height, camera.width)
    twist = torch.tensor([0.05, -0.02, 0.03, 0.01, -0.02, 0.03])
    return [
        Frame(
            index=i,
            timestamp_s=i / 30,
            rgb=torch.zeros(*size, 3),
            depth_m=torch.ones(size),
            camera=camera,
            T_WC=map_of_three.T_WC @ se3.exp(i * twist),
            extra={
                "class": torch.randint(-1, 4, size, generator=generator),
                "moving": torch.rand(size, generator=generator) < 0.3,
                "sigma": torch.rand(size, generator=generator),
                "embedding": torch.randn(*size, 2, 2, generator=generator),
            },
        )
        for i in range(2)
    ]


def blending_weights(params, frame):
    """w(k, p) of each Gaussian and pixel: the picture of a colour that only this Gaussian has."""
    rows = torch.eye(len(params))
    features = render_autograd(params, frame.camera, frame.T_WC, features=rows).features
    assert features is not None
    return features.movedim(2, 0)


@pytest.mark.parametrize("backend", ["reference", "numba"])
def test_columns_are_sums_over_blending_weights(map_of_three, frames, backend):
    params = map_of_three.params
    with use_backend(backend):
        columns = extra_columns(params, frames)
        weights = torch.stack([blending_weights(params, frame) for frame in frames], dim=1)
    seen = weights.sum((1, 2, 3))
    assert (seen > 3).all()
    expected = {"seen_px": seen}
    for name in ("class", "moving"):
        image = torch.stack([frame.extra[name] for frame in frames])
        labels = image.unique()
        shares = [torch.where(image == label, weights, 0).sum((1, 2, 3)) / seen for label in labels]
        share, place = torch.stack(shares, dim=1).max(1)
        expected |= {name: labels.long()[place], f"{name}_share": share}
    for name, places in (("sigma", "khw,khw...->k..."), ("embedding", "")):
        image = torch.stack([frame.extra[name] for frame in frames])
        places = "kfhw,fhw->k" if image.ndim == 3 else "kfhw,fhwab->kab"
        mean = torch.einsum(places, weights, image)
        expected[name] = mean / seen.reshape(-1, *[1] * (mean.ndim - 1))
    assert columns.keys() == expected.keys()
    for name, column in columns.items():
        torch.testing.assert_close(
            torch.from_numpy(column), expected[name], rtol=1e-4, atol=1e-5, check_dtype=False
        )


def test_a_gaussian_that_no_frame_shows_has_zeros(map_of_three, frames):
    xyz_W = map_of_three.params.xyz_W.clone()
    xyz_W[1, 2] = -5.0
    columns = extra_columns(dataclasses.replace(map_of_three.params, xyz_W=xyz_W), frames)
    for column in columns.values():
        assert not column[1].any()
    assert columns["seen_px"][0] > 0


def test_gaussians_before_the_near_plane_count_where_it_is_nearer(map_of_three, frames):
    params = map_of_three.params
    camera_W = frames[0].T_WC[:3, 3]
    near = dataclasses.replace(
        params,
        xyz_W=camera_W + 0.05 * (params.xyz_W - camera_W),
        log_scale=params.log_scale + math.log(0.05),
    )
    assert not extra_columns(near, frames[:1])["seen_px"].any()
    assert (extra_columns(near, frames[:1], 0.01)["seen_px"] > 3).all()


def test_frames_without_images_give_no_columns(map_of_three, frames):
    bare = [dataclasses.replace(frame, extra={}) for frame in frames]
    assert extra_columns(map_of_three.params, bare) == {}
    assert extra_columns(map_of_three.params, []) == {}


def test_what_cannot_become_columns_is_refused(map_of_three, frames, monkeypatch):
    params = map_of_three.params
    taken = dataclasses.replace(frames[0], extra={"seen_px": frames[0].extra["sigma"]})
    with pytest.raises(ArgumentError, match="named 'seen_px'"):
        extra_columns(params, [taken])
    images = {"class": frames[0].extra["class"], "class_share": frames[0].extra["sigma"]}
    with pytest.raises(ArgumentError, match="named 'class_share'"):
        extra_columns(params, [dataclasses.replace(frames[0], extra=images)])
    wide = dict(frames[1].extra) | {"embedding": torch.zeros(12, 16, 3)}
    with pytest.raises(ArgumentError, match=r"pixels \[3\] in a frame and \[2, 2\]"):
        extra_columns(params, [frames[0], dataclasses.replace(frames[1], extra=wide)])
    with pytest.raises(KeyError, match="no extra image 'class'"):
        extra_columns(params, [frames[0], dataclasses.replace(frames[1], extra={})])
    monkeypatch.setattr(module, "MOST_LABELS", 4)
    with pytest.raises(ArgumentError, match="'class' have more than 4 values"):
        extra_columns(params, frames)


@pytest.fixture
def wall(scene, tmp_path):
    """A recording of a wall with labels of its left and its right part, as files."""
    scene = shutil.copytree(scene, tmp_path / "wall")
    (scene / "labels").mkdir()
    sequence = open_sequence(scene)
    for i, frame in enumerate(sequence):
        u = torch.arange(frame.camera.width) + 0.5
        x_W = frame.T_WC[0, 3] + (u - frame.camera.cx) / frame.camera.fx * frame.depth_m
        np.save(scene / f"labels/{i}.npy", np.where(x_W < middle_of(sequence), LEFT, RIGHT))
    return scene


def middle_of(sequence) -> float:
    """The place between the first and the last camera, metres."""
    return float(sequence[0].T_WC[0, 3] + sequence[len(sequence) - 1].T_WC[0, 3]) / 2


def test_labels_in_files_become_labels_of_gaussians(wall, tmp_path):
    out = tmp_path / "run"
    typed = ["map", str(wall), "--extra", "class=labels/{index}.npy", "--out", str(out)]
    assert main([*typed, "--optim.global-iterations", "1", "--tsdf.voxel-size-m", "0.05"]) == 0
    columns = np.load(out / "extra.npz")
    params = read_gaussian_ply(out / "gaussians.ply")
    x_W = params.xyz_W[:, 0].numpy() - middle_of(open_sequence(wall))
    is_seen = (columns["seen_px"] > 1) & (abs(x_W) > 0.1)
    assert is_seen.sum() > 50
    assert set(columns["class"][is_seen & (x_W < 0)]) == {LEFT}
    assert set(columns["class"][is_seen & (x_W > 0)]) == {RIGHT}
    assert columns["class_share"][is_seen].min() > 0.5
    settings = json.loads((out / "config.json").read_text())
    assert settings["source"]["extra"] == {"class": "labels/{index}.npy"}
    assert "extra.npz" in (out / "report.html").read_text()
    assert main(["eval", str(out)]) == 0


def test_map_refuses_images_that_are_not_there(wall, tmp_path, capsys):
    for typed, words in (
        (["class"], "NAME=PATTERN"),
        (["class="], "NAME=PATTERN"),
        (["class=labels/one.npy"], "with {index} or {stem}"),
        (["class=labels/{index}.png"], "does not exist"),
        (["a=labels/{index}.npy", "a=labels/{stem}.npy"], "named twice"),
    ):
        out = tmp_path / "none"
        assert main(["map", str(wall), "--extra", *typed, "--out", str(out)]) == 1
        assert words in capsys.readouterr().err
        assert not out.exists()


SMALL = gsfusion("room", data__stop=5, tsdf__voxel_size_m=0.1, optim__global_iterations=0)


def dark(frame):
    """1 where a pixel is dark."""
    return {"dark": (frame.rgb.mean(2) < 0.5).to(torch.uint8)}


def test_a_function_gives_images_also_to_a_recording_opened_by_name(tmp_path):
    options: dict[str, Any] = {"n_frames": 120, "width": 48, "height": 36}
    run = run_mapping("room", SMALL, folder=tmp_path / "a", extra=dark, evaluate=False, **options)
    opened = open_sequence("room", extra=dark, **options)
    same = run_mapping(opened, SMALL, folder=tmp_path / "b", evaluate=False)
    given = run_mapping(
        open_sequence("room", **options),
        SMALL,
        folder=tmp_path / "c",
        extra=dark,
        evaluate=False,
    )
    columns = [dict(np.load(r.folder / "extra.npz")) for r in (run, same, given)]
    assert set(columns[0]["dark"]) == {0, 1}
    for name, column in columns[0].items():
        assert all(np.array_equal(column, others[name]) for others in columns)


def test_options_for_an_open_sequence_are_refused(small_room, tmp_path):
    with pytest.raises(ArgumentError, match="leave out n_frames"):
        run_mapping(small_room, SMALL, folder=tmp_path / "a", n_frames=5)
    with pytest.raises(ArgumentError, match="leave out extra"):
        run_mapping(small_room, SMALL, folder=tmp_path / "a", extra={"a": "{index}.png"})
    with pytest.raises(KindError, match="extra must be a function"):
        run_mapping("room", SMALL, folder=tmp_path / "a", extra="labels")  # pyright: ignore[reportArgumentType]


def test_a_map_over_a_surface_says_why_it_has_no_columns(tmp_path):
    config = gps_slam("room", data__stop=3, tsdf__voxel_size_m=0.1, final__passes=0)
    run = run_mapping(
        "room", config, folder=tmp_path / "a", extra=dark, evaluate=False, n_frames=120
    )
    assert not (run.folder / "extra.npz").exists()
    assert any("no extra.npz: GPS-SLAM draws" in warning for warning in run.run.warnings)
