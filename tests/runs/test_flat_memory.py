"""Memory while a long recording is mapped: it grows with the map, not with the number of frames."""

import dataclasses
import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from gsfusion_nb.config import replace
from gsfusion_nb.data import RecordedSequence, apply_options, folder
from gsfusion_nb.data.room import RoomSequence
from gsfusion_nb.mapping import make_mapper
from gsfusion_nb.runs import MappingRun, StreamRun

MAX_BYTES_PER_FRAME = 8_000
"""A report, a pose and a time stamp are about 3 kB. One leaked frame of 80x60 would be 77 kB."""

STATM = Path("/proc/self/statm")

pytestmark = pytest.mark.skipif(not STATM.exists(), reason="resident memory is read from /proc")


def written(root: Path, walk: RoomSequence, positions: list[int]) -> RecordedSequence:
    """Frames of a walk, there and back, as files, so that they can be repeated without a jump."""
    (root / "rgb").mkdir(parents=True)
    (root / "depth").mkdir()
    poses = []
    for k, i in enumerate(positions + positions[-2:0:-1]):
        frame = walk[i]
        assert cv2.imwrite(
            str(root / f"rgb/{k:06d}.png"),
            frame.rgb_u8.numpy()[..., ::-1],
        )
        assert cv2.imwrite(
            str(root / f"depth/{k:06d}.png"),
            np.rint(frame.depth_m.numpy() * 5000).astype(np.uint16),
        )
        poses.append(" ".join(f"{v:.9f}" for v in frame.T_WC.flatten().tolist()))
    (root / "poses.txt").write_text("\n".join([*poses, ""]))
    values = dataclasses.asdict(walk.camera) | {"depth_scale": 5000, "pixel_centre": 0.5}
    (root / "intrinsics.json").write_text(json.dumps(values))
    return folder(root)


def repeated(once: RecordedSequence, n: int) -> RecordedSequence:
    """The same files again and again, ``n`` frames."""
    times = -(-n // len(once))
    return dataclasses.replace(
        once,
        rgb_files=(once.rgb_files * times)[:n],
        depth_files=(once.depth_files * times)[:n],
        timestamps_s=[i / 30 for i in range(n)],
        poses=once.poses.repeat(times, 1, 1)[:n],
        pose_sources=(once.pose_sources * times)[:n],
    )


def resident_mb() -> float:
    return int(STATM.read_text().split()[1]) * 4096 / 1e6


def memory_curve(run: MappingRun, every: int) -> np.ndarray:
    """Rows of frame number and resident memory in MB."""
    return np.array([(i, resident_mb()) for i, _ in enumerate(run.online()) if i % every == 0])


def bytes_per_frame(curve: np.ndarray) -> float:
    """Slope of a line through the later four fifths."""
    later = curve[len(curve) // 5 :]
    return float(np.polyfit(later[:, 0], later[:, 1], 1)[0] * 1e6)


def make_run(kind: str, sequence: RecordedSequence, config) -> MappingRun:
    few = {
        "optim__keyframe_iterations": 2,
        "optim__frame_iterations": 1,
        "optim__random_keyframe_iterations": 1,
    }
    settings = replace(config, data__stop=0, data__hold_out_every=8, **few)
    if kind == "stream":
        return StreamRun((frame for frame in sequence), make_mapper(settings))
    return MappingRun(apply_options(sequence, settings.data), make_mapper(settings))


@pytest.mark.parametrize("kind", ["sequence", pytest.param("stream", marks=pytest.mark.ci)])
def test_memory_is_flat_over_300_frames(tmp_path, small_room, config, kind):
    sequence = repeated(written(tmp_path, small_room, list(range(7))), 300)
    run = make_run(kind, sequence, config)
    curve = memory_curve(run, 10)
    assert len(run.steps) > 240
    assert bytes_per_frame(curve) < 3 * MAX_BYTES_PER_FRAME  # fewer frames, more scatter
