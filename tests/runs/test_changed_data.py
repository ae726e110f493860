"""A run goes on only with the data that it began with."""

import json
import shutil

import cv2
import pytest

from gsfusion_nb.config import gsfusion
from gsfusion_nb.data import SequenceError
from gsfusion_nb.runs import resume_mapping, run_mapping


class Killed(BaseException):
    """Ends a run as a kill does: nothing is saved any more."""


@pytest.fixture
def killed(scene, tmp_path, monkeypatch):
    """The folders of a run that was killed after its third frame of five, and of its recording."""
    from gsfusion_nb.runs import CheckpointEvery, map_sequence

    shutil.copytree(scene, tmp_path / "wall")
    config = gsfusion(
        "replica",
        sh_degree=0,
        tsdf__voxel_size_m=0.08,
        optim__global_iterations=1,
        data__hold_out_every=4,
        data__hold_out_offset=2,
    )

    class Watch:
        def frame_mapped(self, mapper, frame, report):
            if mapper.n_frames == 4:
                raise Killed

        def finished(self, mapper, mesh, metrics):
            pass

    with monkeypatch.context() as patch:
        patch.setattr(map_sequence, "_rescue", lambda *_: None)
        with pytest.raises(Killed):
            run_mapping(
                tmp_path / "wall", config, folder=tmp_path / "run", evaluate=False, watch=Watch(),
                checkpoints=CheckpointEvery(seconds=0, frames=1),
            )  # fmt: skip
    return tmp_path / "run", tmp_path / "wall"


def edit_intrinsics(wall, name, factor):
    path = wall / "intrinsics.json"
    values = json.loads(path.read_text())
    path.write_text(json.dumps(values | {name: values[name] * factor}))


def invert(wall):
    path = str(wall / "rgb/000005.png")
    image = cv2.imread(path)
    assert image is not None
    cv2.imwrite(path, 255 - image)


def one_digit(wall):
    path = wall / "poses.txt"
    path.write_text(path.read_text().replace("5", "6", 1))


def one_more(wall):
    for kind in ("rgb", "depth"):
        shutil.copyfile(wall / f"{kind}/000006.png", wall / f"{kind}/000007.png")
    (wall / "poses.txt").write_text((wall / "poses.txt").read_text() + "1 0 0 1 0 1 0 0 0 0 1 0 0 0 0 1\n")


def one_less(wall):
    for kind in ("rgb", "depth"):
        (wall / f"{kind}/000006.png").unlink()


CHANGES = {
    "an image not mapped yet": (invert, "rgb/000005.png (changed)"),
    "a pose": (one_digit, "poses.txt (changed)"),
    "the intrinsics": (lambda wall: edit_intrinsics(wall, "fx", 1.01), "intrinsics.json (changed)"),
    "the depth scale": (lambda wall: edit_intrinsics(wall, "depth_scale", 2), "intrinsics.json (changed)"),
    "a frame more": (one_more, "poses.txt (changed)"),
    "a frame less": (one_less, "rgb/000006.png (deleted)"),
    "a held-out image": (lambda wall: (wall / "depth/000006.png").write_bytes(b""), "depth/000006.png (changed)"),
}


@pytest.mark.parametrize("change", CHANGES)
def test_changed_data_are_refused_and_named(killed, change):
    folder, wall = killed
    act, named = CHANGES[change]
    act(wall)
    with pytest.raises(SequenceError) as refused:
        resume_mapping(folder, evaluate=False)
    assert f"{wall}/{named}" in str(refused.value)
    assert "--changed-data" in str(refused.value)


def test_the_same_data_go_on_and_changed_ones_only_if_asked(killed):
    folder, wall = killed
    shutil.copytree(folder, folder.parent / "other")
    (wall / "notes.txt").write_text("not read by a run")
    whole = resume_mapping(folder, evaluate=False)
    assert whole.run.status == "complete"
    assert not any("files of the recording" in warning for warning in whole.run.warnings)
    invert(wall)
    mixed = resume_mapping(folder.parent / "other", evaluate=False, changed_data=True)
    assert mixed.run.hashes["gaussians"] != whole.run.hashes["gaussians"]
    assert "rgb/000005.png (changed); it went on all the same" in " ".join(mixed.run.warnings)
