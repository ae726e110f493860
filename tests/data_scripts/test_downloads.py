"""Every script that downloads, end to end against a server on this machine, with tiny archives in
the real layout."""

import hashlib
import json
import runpy
from pathlib import Path

import pytest
import torch

from gsfusion_nb.data import open_sequence
from gsfusion_nb.data.readers.tum import LENSES
from gsfusion_nb.types import Camera

SCRIPTS_FOLDER = Path(__file__).resolve().parents[2] / "data_scripts"
SCRIPTS = sorted(SCRIPTS_FOLDER.glob("*.py"))


def run(module, site, out, *arguments):
    module.HOST = site.address
    return module.main([*arguments, "--out", str(out), "--yes"])


@pytest.fixture
def tum_set(site, tmp_path, box, archives, writer, files):
    """fr1_desk with two frames."""
    name = "rgbd_dataset_freiburg1_desk"
    root = writer("tum")(
        tmp_path / "made" / name,
        box,
        n=2,
        camera=LENSES["freiburg1"].camera,
    )
    (root / "accelerometer.txt").write_text("# nothing\n")
    path = f"/freiburg1/{name}.tgz"
    site.files[path] = archives.tgz(files(root, f"{name}/"))
    return path


def test_tum(script, site, tum_set, tmp_path, capsys):
    module = script("tum")
    out = tmp_path / "data"
    assert run(module, site, out, "fr1_desk") == 0
    text = capsys.readouterr().out
    folder = out / "tum/rgbd_dataset_freiburg1_desk"
    for part in ("CC BY 4.0", "no checksum", "Sturm", f"gsfusion-nb map {folder} --preset tum"):
        assert part in text
    sequence = open_sequence(folder)
    assert len(sequence) == 2
    assert sequence.camera.fx == pytest.approx(517.3, rel=0.06)
    (record,) = json.loads((folder / "source.json").read_text())["files"]
    assert record["sha256"] == hashlib.sha256(site.files[tum_set]).hexdigest()
    assert record["url"] == site.address + tum_set


def test_nobody_agrees(script, site, tum_set, tmp_path, capsys):
    assert script("tum").main(["fr1_desk", "--out", str(tmp_path / "data")]) == 1
    shown = capsys.readouterr()
    assert "CC BY 4.0" in shown.out
    assert "--yes" in shown.err
    assert site.seen == []


def test_seven_scenes(script, site, tmp_path, box, archives, writer, files, capsys):
    write = writer("seven_scenes")
    inner = {}
    for name in ("seq-01", "seq-02"):
        root = write(tmp_path / "made" / name, box, n=2)
        inner[f"heads/{name}.zip"] = archives.zip(
            files(root, f"{name}/") | {f"{name}/Thumbs.db": b"x"}
        )
    split = {
        "heads/TrainSplit.txt": b"sequence2\n",
        "heads/TestSplit.txt": b"sequence1\n",
        "heads/heads.png": b"x",
    }
    site.files["/heads.zip"] = archives.zip(inner | split)
    out = tmp_path / "data"
    assert run(script("seven_scenes"), site, out, "heads") == 0
    text = capsys.readouterr().out
    assert "NON-COMMERCIAL" in text
    folder = out / "7scenes/heads"
    assert sorted(p.name for p in folder.iterdir()) == [
        "TestSplit.txt",
        "TrainSplit.txt",
        "seq-01",
        "seq-02",
        "source.json",
    ]
    assert not (folder / "seq-01/Thumbs.db").exists()
    assert f"gsfusion-nb map {folder}/seq-02 --preset tum --reader register=true" in text
    assert len(open_sequence(folder / "seq-01", register=True)) == 2


def test_replica(script, site, tmp_path, box, archives, writer, files, capsys):
    made = tmp_path / "made"
    for scene in ("office0", "room0"):
        writer("replica")(made / scene, box, n=3)
        (made / f"{scene}_mesh.ply").write_bytes(b"ply of " + scene.encode())
    site.files["/data/Replica.zip"] = archives.zip(files(made, "Replica/"))
    meshes = {
        f"cull_replica_mesh/{scene}.ply": b"culled " + scene.encode()
        for scene in ("office0", "room0")
    }
    site.files["/cull_replica_mesh.zip"] = archives.zip(meshes)
    out = tmp_path / "data"
    assert run(script("replica"), site, out, "office0", "room0") == 0
    text = capsys.readouterr().out
    for scene in ("office0", "room0"):
        folder = out / "replica" / scene
        assert f"gsfusion-nb map {folder} --preset replica" in text
        sequence = open_sequence(folder)
        assert len(sequence) == 3
        assert sequence.camera.fx == box.camera.fx
        assert box.off_wall_m(sequence[2]) < 0.0001
        assert (folder / "mesh.ply").read_bytes() == b"ply of " + scene.encode()
        assert (folder / "mesh_culled.ply").read_bytes() == b"culled " + scene.encode()
    assert len(site.seen) == 2  # the archive came once
    assert not list((out / ".fetch").rglob("*.zip"))


@pytest.fixture
def icl(script, site, tmp_path, box, archives):
    """livingroom1 with three frames, and its own checksums."""
    module = script("icl_nuim")
    colour = {}
    depth = {}
    log = []
    camera = Camera(
        width=640,
        height=480,
        fx=525.0,
        fy=525.0,
        cx=320.0,
        cy=240.0,
    )
    for i, T_WC in enumerate(box.poses(3)):
        rgb_file = tmp_path / f"made/{i:05d}.jpg"
        depth_file = tmp_path / f"made/{i:05d}.png"
        box.write_pair(rgb_file, depth_file, T_WC, 1000, camera)
        colour[rgb_file.name] = rgb_file.read_bytes()
        depth[depth_file.name] = depth_file.read_bytes()
        log += [
            f"{i} {i} {i + 1}",
            *(" ".join(f"{value:.8f}" for value in row) for row in T_WC.tolist()),
        ]
    contents = {
        "livingroom1-color.zip": archives.zip(colour),
        "livingroom1-depth-clean.zip": archives.zip(depth),
        "livingroom1-traj.txt": "\n".join([*log, ""]).encode(),
        "livingroom.ply.zip": archives.zip({"livingroom.ply": b"ply\n"}),
    }
    for name, content in contents.items():
        site.files[f"/{name}"] = content
        module.MD5[name] = hashlib.md5(content).hexdigest()
    return module


def test_icl_nuim(icl, site, tmp_path, box, capsys):
    out = tmp_path / "data"
    assert run(icl, site, out, "livingroom1-clean") == 0
    text = capsys.readouterr().out
    assert text.count("compared with its published md5") == 4
    folder = out / "icl_nuim/livingroom1-clean"
    assert f"gsfusion-nb map {folder} --preset replica" in text
    sequence = open_sequence(folder)
    assert len(sequence) == 3
    assert all(box.off_wall_m(frame) < 0.0005 for frame in sequence)
    assert (folder / "groundtruth.ply").read_bytes() == b"ply\n"
    files = json.loads((folder / "source.json").read_text())["files"]
    assert all(entry["published"].startswith("md5:") for entry in files)


def test_icl_nuim_poses_go_to_images_by_number(icl, site, tmp_path, capsys):
    """Of a log without a pose, no later pose is shifted."""
    log = site.files["/livingroom1-traj.txt"].decode().splitlines()
    content = "\n".join([*log[:5], *log[10:], ""]).encode()
    site.files["/livingroom1-traj.txt"] = content
    icl.MD5["livingroom1-traj.txt"] = hashlib.md5(content).hexdigest()
    assert run(icl, site, tmp_path / "other", "livingroom1-clean") == 1
    assert "trajectory.log lacks the pose of frame 1" in capsys.readouterr().err


@pytest.mark.parametrize("name", [path.stem for path in SCRIPTS])
def test_import_does_nothing_and_help_helps(name, script, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    module = script(name)  # a name look-up would fail here
    with pytest.raises(SystemExit) as done:
        module.main(["--help"])
    assert done.value.code == 0
    text = capsys.readouterr().out
    assert f"python data_scripts/{name}.py" in text
    assert "--out" in text
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(SystemExit):
        module.main([])


@pytest.mark.parametrize("name", sorted(runpy.run_path(str(SCRIPTS_FOLDER / "tum.py"))["SIZES_GB"]))
def test_every_sequence_of_tum_opens(script, site, tmp_path, box, archives, writer, files, name):
    """In the folder that the benchmark gives it, which says whose camera it is, with what the
    published ground truth has: a time twice, 1.2 mm apart (fr2_desk), and its three comments."""
    module = script("tum")
    plan = module.plan(name)
    folder_name = Path(plan.folder).name
    camera = folder_name.split("_")[2]
    root = writer("tum")(tmp_path / "made" / folder_name, box, n=2, camera=LENSES[camera].camera)
    truth = root / "groundtruth.txt"
    rows = [line for line in truth.read_text().splitlines() if not line.startswith("#")]
    time, x, *rest = rows[0].split()
    comments = ["# ground truth trajectory", f"# file: '{folder_name}.bag'"]
    header = "# timestamp tx ty tz qx qy qz qw"
    again = " ".join([time, f"{float(x) + 0.0012:.6f}", *rest])
    truth.write_text("\n".join([*comments, header, rows[0], again, *rows[1:], ""]))
    (item,) = plan.items
    path = item.url.removeprefix(module.HOST)
    site.files[path] = archives.tgz(files(root, f"{folder_name}/"))
    assert run(module, site, tmp_path / "data", name) == 0
    sequence = open_sequence(tmp_path / "data" / plan.folder)
    assert len(sequence) == 2
    assert sequence.camera.fx == pytest.approx(LENSES[camera].camera.fx, rel=0.07)
    assert torch.allclose(sequence[0].T_WC.double(), box.pose_at(0.112), atol=2e-3)
