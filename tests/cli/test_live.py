import json
import sys

import cv2
import numpy as np
import pytest

from gsfusion_nb.cli.live import live
from gsfusion_nb.data import SequenceNotFoundError

SETTINGS = [
    "--tsdf.voxel-size-m",
    "0.04",
    "--optim.global-iterations",
    "1",
    "--sh-degree",
    "0",
    "--data.hold-out-every",
    "0",
]


@pytest.fixture
def ended_folder(tmp_path, small_room):
    """Six frames in the plain layout, and the file that says that no more will come."""
    root = tmp_path / "scan"
    for kind in ("rgb", "depth"):
        (root / kind).mkdir(parents=True)
    poses = []
    for i in range(6):
        frame = small_room[i]
        assert cv2.imwrite(
            str(root / f"rgb/{i}.png"),
            frame.rgb_u8.numpy()[..., ::-1],
        )
        assert cv2.imwrite(
            str(root / f"depth/{i}.png"),
            np.rint(frame.depth_m.numpy() * 5000).astype(np.uint16),
        )
        poses.append(" ".join(f"{v:.9f}" for v in frame.T_WC.flatten().tolist()))
    (root / "poses.txt").write_text("\n".join([*poses, ""]))
    values = vars(small_room.camera) | {"depth_scale": 5000, "pixel_centre": 0.5}
    (root / "intrinsics.json").write_text(json.dumps(values))
    (root / "stop").touch()
    return root


def test_a_folder_is_followed_to_its_end(ended_folder, tmp_path):
    arguments = [
        "folder",
        str(ended_folder),
        "--out",
        str(tmp_path / "run"),
        *SETTINGS,
        "--frames",
        "5",
    ]
    run = live(arguments)
    assert run.run.status == "complete"
    assert run.metrics["n_frames"] == 5
    assert run.metrics["policy"] == "all"
    assert (run.folder / "report.html").is_file()
    settings = json.loads((run.folder / "config.json").read_text())["config"]
    assert settings["tsdf"]["voxel_size_m"] == 0.04
    assert settings["tracking"]["poses"] == "given"


def test_what_cannot_be_is_said_in_a_sentence(ended_folder, tmp_path, monkeypatch, capsys):
    with pytest.raises(KeyError, match="no live source 'webcam'; known: folder, realsense"):
        live(["webcam"])
    with pytest.raises(
        SequenceNotFoundError, match="expected one in which a recording is being written"
    ):
        live(["folder", str(tmp_path / "nowhere")])
    with pytest.raises(KeyError, match="no preset 'repilca'; known:"):
        live(["folder", str(ended_folder), "--preset", "repilca"])
    with pytest.raises(SystemExit):
        live(["folder", str(ended_folder), "--tsdf.voxel", "1"])
    assert "voxel-size-m" in capsys.readouterr().err
    monkeypatch.setitem(sys.modules, "pyrealsense2", None)
    with pytest.raises(SequenceNotFoundError, match=r"pip install 'gsfusion-nb\[realsense\]'"):
        live(["realsense", "--out", str(tmp_path / "camera")])
