"""A camera is looked for in the map of a finished run, and goes on in it; a simulated one here."""

import dataclasses
import itertools
import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from earlier_runs import ROOM, StopAfter, hashes, map_first_frames

from gsfusion_nb.cli import main
from gsfusion_nb.cli.live import live
from gsfusion_nb.config import replace
from gsfusion_nb.data.room import room
from gsfusion_nb.data.stream import LiveSource
from gsfusion_nb.errors import SequenceError
from gsfusion_nb.mapping import make_mapper
from gsfusion_nb.runs import (
    CheckpointEvery,
    StreamRun,
    map_stream,
    resume_mapping,
    stream_onto,
)


class Camera(LiveSource):
    """Frames of the room's walk, without poses; frames of another place come first."""

    name = "camera"
    policy = "all"

    def __init__(self, indices, **size: Any):
        self.source = room(**(ROOM | size))
        self.indices = iter(indices)

    def __iter__(self):
        for index in self.indices:
            yield dataclasses.replace(self.source[index], T_WC=torch.eye(4))

    def stop(self):
        self.indices = iter(())


@pytest.fixture(scope="module")
def parent(tmp_path_factory) -> Path:
    """The folder of a run on the first frames of the walk."""
    return map_first_frames(tmp_path_factory.mktemp("parent") / "run")


def errors_m(run: Any, indices: list[int], **size: Any) -> list[float]:
    """How far the cameras are from where they were."""
    source = room(**(ROOM | size))
    pairs = zip(run.poses, indices, strict=True)
    return [float((T_WC[:3, 3] - source.true_pose(i)[:3, 3]).norm()) for T_WC, i in pairs]


def test_a_camera_is_located_and_its_frames_count_from_zero(parent, tmp_path):
    before = hashes(parent)
    run = stream_onto(Camera([60, 61, *range(8, 14)]), parent)
    assert run.mapper.localiser.is_before_first_look
    assert len(run.mapper.gaussians)
    finished = map_stream(run, folder=tmp_path / "run")
    assert not run.mapper.localiser.is_before_first_look
    assert run.status == "complete"
    indices = run.mapper.trajectory.frame_indices
    assert indices[10:] == [2, 3, 4, 5, 6, 7]
    assert max(indices[:10]) < 0
    assert max(errors_m(run, list(range(8, 14)))) < 0.02
    assert finished.metrics["n_frames"] == 6
    assert finished.metrics["n_frames_unusable"] == 2
    assert finished.metrics["psnr_mapped_db"] > 18
    assert hashes(parent) == before
    maps = json.loads((parent / "metrics.json").read_text())["sha256"]
    for name in ("metrics.json", "config.json"):
        document = json.loads((finished.folder / name).read_text())
        assert document["onto"] == {"run": str(parent.resolve()), "sha256": maps}
    assert f"in the map of {parent.name}" in (finished.folder / "report.html").read_text()


def test_another_camera_is_known_from_its_first_frame(parent, tmp_path):
    small: dict[str, Any] = {"width": 128, "height": 96}
    run = stream_onto(Camera(range(8, 12), **small), parent)
    map_stream(run, folder=tmp_path / "run", evaluate=False)
    assert max(errors_m(run, list(range(8, 12)), **small)) < 0.03
    assert run.mapper.localiser.memory.camera == room(**(ROOM | small)).camera


def test_a_camera_that_is_nowhere_in_the_map_can_be_ended(parent, tmp_path):
    asked = itertools.count()
    run = stream_onto(Camera(itertools.repeat(60)), parent, until=lambda: next(asked) >= 3)
    with pytest.raises(SequenceError, match="no frame of camera could be mapped, the first"):
        list(run.online())
    assert run.n_unusable <= 4
    assert run.mapper.localiser.is_before_first_look


def test_a_killed_run_is_finished_with_its_parent(parent, tmp_path):
    run = stream_onto(Camera(range(8, 14)), parent, keep_moved=True)
    with pytest.raises(RuntimeError, match="stopped"):
        map_stream(
            run,
            folder=tmp_path / "run",
            evaluate=False,
            watch=StopAfter(3),
            checkpoints=CheckpointEvery(frames=1),
        )
    resumed = resume_mapping(tmp_path / "run", evaluate=False).run
    assert len(resumed.steps) == len(resumed.poses) == 3
    assert resumed.parent == run.parent
    assert resumed.moved is not None
    assert resumed.moved.keeps
    assert [step.frame_index for step in resumed.steps] == [0, 1, 2]


def written(root: Path, indices: range) -> Path:
    """Frames in the plain layout without poses, and the file that says that no more will come."""
    source = room(**ROOM)
    for kind in ("rgb", "depth"):
        (root / kind).mkdir(parents=True)
    for i, index in enumerate(indices):
        frame = source[index]
        depth = np.rint(frame.depth_m.numpy() * 5000).astype(np.uint16)
        assert cv2.imwrite(str(root / f"rgb/{i}.png"), frame.rgb_u8.numpy()[..., ::-1])
        assert cv2.imwrite(str(root / f"depth/{i}.png"), depth)
    values = vars(source.camera) | {"depth_scale": 5000, "pixel_centre": 0.5}
    (root / "intrinsics.json").write_text(json.dumps(values))
    (root / "stop").touch()
    return root


def test_the_command_goes_on_and_its_run_can_be_gone_on_from(parent, tmp_path):
    scan = written(tmp_path / "scan", range(8, 13))
    words = ["folder", str(scan), "--no-poses", "--onto", str(parent), "--keep-moved"]
    first = live([*words, "--out", str(tmp_path / "first"), "--no-evaluate"])
    assert max(errors_m(first.run, list(range(8, 13)))) < 0.02
    assert first.run.moved is not None
    assert first.run.moved.keeps
    assert first.mapper.config.tsdf.voxel_size_m == 0.04
    again = ["live", "folder", str(scan), "--no-poses", "--onto", str(tmp_path / "first")]
    assert main([*again, "--out", str(tmp_path / "second"), "--no-evaluate"]) == 0
    document = json.loads((tmp_path / "second" / "metrics.json").read_text())
    assert document["onto"]["run"] == str(tmp_path / "first")
    assert [row["frame_index"] for row in document["frames"]] == [0, 1, 2, 3, 4]


def test_what_cannot_go_together_is_refused(parent, tmp_path, capsys):
    scan = written(tmp_path / "scan", range(8, 10))
    words = ["live", "folder", str(scan), "--no-poses", "--out", str(tmp_path / "run")]
    onto = ["--onto", str(parent)]
    for options, said in (
        (["--keep-moved"], "--keep-moved is for --onto RUN"),
        ([*onto, "--tsdf.voxel-size-m", "0.02"], "tsdf.voxel_size_m 0.04, not 0.02"),
        (["--onto", str(tmp_path / "none")], "expected the folder of a finished run"),
    ):
        assert main([*words, *options]) == 1
        assert said in capsys.readouterr().err.replace("\n", " ")
    assert not (tmp_path / "run").exists()
    run = stream_onto(Camera([8]), parent)
    mapper = make_mapper(replace(run.mapper.config, tracking__poses="given"))
    with pytest.raises(ValueError, match="has a mapper and a policy; leave out others"):
        map_stream(run, mapper)
    with pytest.raises(ValueError, match="expected a mapper for the frames"):
        map_stream(Camera([8]))
    assert isinstance(run, StreamRun)
