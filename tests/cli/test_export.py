"""``gsfusion-nb export``: right side up, from a run's folder and from a file."""

import json

import pytest
import torch

from gsfusion_nb.cli import main
from gsfusion_nb.export import (
    read_gaussian_ply,
    read_mesh_ply,
    write_gaussian_ply,
    write_mesh_ply,
    write_trajectory_tum,
)
from gsfusion_nb.types import GaussianParams, Mesh


@pytest.fixture
def folder(tmp_path):
    """A run with z up: a Gaussian and a corner one metre above the floor."""
    one = GaussianParams(
        xyz_W=torch.tensor([[0.0, 2.0, 1.0]]),
        log_scale=torch.zeros(1, 3),
        quat=torch.tensor([[1.0, 0, 0, 0]]),
        opacity_logit=torch.zeros(1),
        sh=torch.zeros(1, 16, 3),
    )
    corners = torch.tensor([[0.0, 2.0, 1.0], [1, 0, 0], [0, 1, 0]])
    # looks along y, its -y is z
    level = torch.tensor([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
    write_gaussian_ply(tmp_path / "run/gaussians.ply", one)
    mesh = Mesh(
        vertices_W=corners,
        faces=torch.tensor([[0, 1, 2]], dtype=torch.int32),
        rgb=torch.full((3, 3), 0.5),
    )
    write_mesh_ply(tmp_path / "run/mesh.ply", mesh)
    write_trajectory_tum(tmp_path / "run/trajectory.txt", [0.0, 1.0], torch.stack([level, level]))
    return tmp_path / "run"


def test_a_folder_has_all_files_in_one_frame(folder, tmp_path, capsys):
    assert main(["export", str(folder), str(tmp_path / "out")]) == 0
    said = capsys.readouterr().out
    assert (
        "Up is +z in the map: the mean of the up directions of 2 cameras, trajectory.txt." in said
    )
    gaussians = read_gaussian_ply(tmp_path / "out/gaussians.ply")
    mesh = read_mesh_ply(tmp_path / "out/mesh.ply")
    assert gaussians.xyz_W.tolist() == [[0, -1, 2]]  # one metre above the floor: y = -1
    assert mesh.vertices_W[0].tolist() == [0, -1, 2]
    assert (tmp_path / "out/map.glb").read_bytes()[:4] == b"glTF"


def test_from_file_to_file(folder, tmp_path):
    first = folder / "gaussians.ply"
    second = tmp_path / "b.ply"
    assert main(["export", str(first), str(second), "--up", "+z"]) == 0
    assert torch.allclose(
        read_gaussian_ply(second).xyz_W,
        torch.tensor([[0.0, -1, 2]]),
    )
    assert main(["export", str(first), str(second), "--no-upright"]) == 0
    assert read_gaussian_ply(second).xyz_W.tolist() == [[0, 2, 1]]


def test_an_openusd_stage_has_the_camera_that_the_run_names(folder, tmp_path, capsys):
    stage = tmp_path / "map.usda"
    assert main(["export", str(folder), str(stage)]) == 0
    assert "does not say which camera" in capsys.readouterr().out
    assert "def Camera" not in stage.read_text()
    camera = {"width": 64, "height": 48, "fx": 60.0, "fy": 58.0, "cx": 31.3, "cy": 24.9}
    (folder / "config.json").write_text(json.dumps({"camera": camera}))
    assert main(["export", str(folder), str(stage), "--no-mesh"]) == 0
    assert "+y up" in capsys.readouterr().out
    text = stage.read_text()
    assert text.count("xformOp:transform.timeSamples") == 1
    assert "def Mesh" not in text


def test_a_camera_without_its_width_is_a_sentence(folder, tmp_path, capsys):
    camera = {"height": 48, "fx": 60.0, "fy": 58.0, "cx": 31.3, "cy": 24.9}
    (folder / "config.json").write_text(json.dumps({"camera": camera}))
    assert main(["export", str(folder), str(tmp_path / "map.usda"), "--no-mesh"]) == 1
    assert (
        "config.json is not readable as the settings of a run, with width"
        in capsys.readouterr().err
    )


WRONG = (None, "text", -1.5, True, [], {}, [1], {"a": 1})


def test_wrong_fields_of_the_settings_are_sentences_that_name_the_file(folder, tmp_path, capsys):
    """Each field of the camera, and the parts that say which system and settings: missing, and of
    each wrong kind."""
    (folder / "tsdf.npz").touch()  # so that a .ply file needs system and settings
    (folder / "metrics.json").write_text('{"metrics": {}}')
    camera = {"width": 64, "height": 48, "fx": 60.0, "fy": 58.0, "cx": 31.3, "cy": 24.9}
    good = {
        "system": "gps_slam",
        "source": {"path_or_name": "room"},
        "device": "cpu",
        "camera": camera,
        "config": {},
    }
    stage = str(tmp_path / "map.usda")
    cloud = str(tmp_path / "map.ply")
    said = []

    def check(document, *commands):
        (folder / "config.json").write_text(json.dumps(document))
        for command in commands:
            status = main(list(command))
            text = capsys.readouterr().err
            said.append(text)
            assert status == 1, (document, command)
            assert "unexpected error" not in text, text
            assert str(folder) in text, text

    to_stage = ("export", str(folder), stage, "--no-mesh")
    to_cloud = ("export", str(folder), cloud)
    for name in camera:
        check(
            {**good, "camera": {k: v for k, v in camera.items() if k != name}},
            to_stage,
        )
        for value in WRONG:
            # a principal point may lie outside of the image
            if not (name in ("cx", "cy") and value == -1.5):
                check({**good, "camera": {**camera, name: value}}, to_stage)
    for value in WRONG:
        check({**good, "camera": value}, to_stage)
        check({**good, "system": value}, to_cloud, ("eval", str(folder)))
        check({**good, "device": value}, ("eval", str(folder)))
        if value != {}:
            check({**good, "config": value}, to_cloud, ("eval", str(folder)))
        check({**good, "source": value}, ("eval", str(folder)))
    assert len(said) > 90


@pytest.mark.parametrize(
    ("out", "more", "sentence"),
    [
        ("map.obj", [], "must end in .glb, .usda or .ply, or be a folder"),
        ("map.glb", ["--up", "z"], "no up axis 'z'; known: +x, +y, +z, -x, -y, -z"),
        ("map.glb", ["--up", "0,0,0"], "direction of three numbers"),
    ],
)
def test_mistakes_are_answered_with_a_sentence(folder, tmp_path, capsys, out, more, sentence):
    assert main(["export", str(folder), str(tmp_path / out), *more]) == 1
    assert sentence in capsys.readouterr().err
    assert not (tmp_path / out).exists()
