"""Data sets that are offered open as they are published, and as they lie on disks: marks, line
ends, lost rows."""

import json
from typing import Any

import pytest
import torch
from published_layouts import TEST, TRAIN, scannetpp_layout, seven_scenes_layout, tum_layout

from gsfusion_nb.data import SequenceError, open_sequence
from gsfusion_nb.data.adjust.repair import as_read


def read(root) -> Any:
    """What the reader of a layout returns, without the repairs around it."""
    return as_read(open_sequence(root).source)


def tum_folder(root, box):
    return tum_layout(root / "rgbd_dataset_freiburg3_box", box)


def replica_folder(root, box):
    (root / "Replica").mkdir(parents=True)
    return box.replica(root / "Replica/office0")


LAYOUTS = {
    "tum": tum_folder,
    "replica": replica_folder,
    "scannetpp": scannetpp_layout,
    "seven_scenes": seven_scenes_layout,
    "folder": lambda root, box: box.folder(root),
}


def with_mark(text):
    return "\ufeff" + text


def of_windows(text):
    return text.replace("\n", "\r\n")


def with_empty_end(text):
    return text.rstrip("\n") + "  \n\n \n"


def without_end(text):
    return text.rstrip("\n")


@pytest.mark.parametrize("layout", LAYOUTS)
def test_text_files_as_other_systems_write_them(tmp_path, box, layout):
    root = LAYOUTS[layout](tmp_path / "scan", box)
    wanted = read(root)
    files = [file for file in (tmp_path / "scan").rglob("*") if file.suffix in (".txt", ".json")]
    texts = {file: file.read_text() for file in files}
    for change in (with_mark, of_windows, with_empty_end, without_end):
        for file, text in texts.items():
            file.write_bytes(change(text).encode())
        found = read(root)
        assert found.camera == wanted.camera, change
        assert torch.equal(found.poses, wanted.poses), change
        assert found.timestamps_s == wanted.timestamps_s, change


def test_ground_truth_in_another_order_with_lost_and_repeated_rows(tmp_path, box):
    """fr2_desk repeats a time, and motion capture that lost its markers gives NaN."""
    root = tum_folder(tmp_path, box)
    wanted = read(root)
    file = root / "groundtruth.txt"
    comment, *rows = file.read_text().splitlines()
    lost = f"{float(rows[-1].split()[0]) + 0.002:.4f} nan nan nan nan nan nan nan"
    file.write_text("\n".join([comment, *reversed(rows), lost, rows[3], "# the end", ""]))
    assert torch.equal(read(root).poses, wanted.poses)


@pytest.mark.parametrize("lost", ["pose", "image", "depth"])
def test_images_that_were_taken_out_of_a_release(tmp_path, box, caplog, lost):
    """Later releases of ScanNet++ lack images whose poses were wrong; the lists still name them."""
    root = scannetpp_layout(tmp_path / "scan", box)
    name = TRAIN[1]
    if lost == "pose":
        file = root / "dslr/nerfstudio/transforms_undistorted_2.json"
        values = json.loads(file.read_text())
        values["frames"] = [frame for frame in values["frames"] if frame["file_path"] != name]
        file.write_text(json.dumps(values))
    elif lost == "image":
        (root / f"dslr/undistorted_images_2/{name}").unlink()
    else:
        (root / f"dslr/undistorted_depths_2/{name.replace('JPG', 'png')}").unlink()
    source: Any = open_sequence(root).source
    assert [file.name for file in source.rgb_files] == [TRAIN[0], TRAIN[2], *TEST]
    assert source.novel == {2}
    assert "1 of 4 listed images are left out" in caplog.text
    assert all(box.off_wall_m(frame) < 0.001 for frame in source)


def test_a_scene_of_which_nothing_is_left(tmp_path, box):
    root = scannetpp_layout(tmp_path / "scan", box)
    for file in (root / "dslr/undistorted_depths_2").iterdir():
        file.unlink()
    with pytest.raises(
        SequenceError, match=r"4 of the 4 images .* have no pose, no image or no depth"
    ):
        open_sequence(root)
