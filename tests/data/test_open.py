"""Opening by path, and the options of DataConfig."""

import pytest
import torch

from gsfusion_nb.config import DataConfig
from gsfusion_nb.data import (
    BadFrameError,
    Sequence,
    SequenceError,
    SequenceNotFoundError,
    apply_options,
    detect_layout,
    open_sequence,
)
from gsfusion_nb.data.open import known_layouts
from gsfusion_nb.types import Camera, Frame


class Synthetic:
    """Ten tiny frames; depth of frame i is i + 1 metres on the left half and missing on the
    right."""

    name = "synthetic"
    camera = Camera(
        width=8,
        height=6,
        fx=8.0,
        fy=8.0,
        cx=4.0,
        cy=3.0,
    )

    def __init__(self, n=10):
        self.n = n
        self.decoded = []

    def __len__(self):
        return self.n

    def pose(self, i):
        T = torch.eye(4)
        T[0, 3] = i
        return T

    def __getitem__(self, i):
        if not 0 <= i < self.n:
            raise IndexError(i)
        self.decoded.append(i)
        depth_m = torch.zeros(6, 8)
        depth_m[:, :4] = i + 1.0
        return Frame(
            index=i,
            timestamp_s=i / 10,
            rgb=torch.rand(6, 8, 3),
            depth_m=depth_m,
            camera=self.camera,
            T_WC=self.pose(i),
        )


def indices(view):
    return [f.index for f in view]


@pytest.mark.parametrize(
    ("config", "mapped", "held"),
    [
        (DataConfig(), [0, 1, 2, 3, 5, 6, 7, 8, 9], [4]),
        (DataConfig(hold_out_every=0), list(range(10)), []),
        (DataConfig(hold_out_every=3, hold_out_offset=0), [1, 2, 4, 5, 7, 8], [0, 3, 6, 9]),
        (DataConfig(start=2, stop=9, hold_out_every=0), [2, 3, 4, 5, 6, 7, 8], []),
        (DataConfig(start=7, stop=99, hold_out_every=0), [7, 8, 9], []),
        (DataConfig(start=1, stride=2, hold_out_every=2, hold_out_offset=1), [1, 5, 9], [3, 7]),
    ],
)
def test_selection(config, mapped, held):
    source = Synthetic()
    seq = apply_options(source, config)
    assert source.decoded == []  # lazy
    assert indices(seq.mapping) == mapped
    assert indices(seq.held_out) == held
    assert indices(seq) == sorted(mapped + held)
    assert isinstance(seq, Sequence)
    assert isinstance(seq.mapping, Sequence)
    assert [float(seq.mapping.pose(i)[0, 3]) for i in range(len(seq.mapping))] == mapped
    assert seq.mapping[-1].index == mapped[-1]
    with pytest.raises(IndexError):
        seq.mapping[len(mapped)]


@pytest.mark.parametrize(
    ("config", "n", "pattern"),
    [
        (
            DataConfig(start=10),
            10,
            r"synthetic has 10 frames; data\.start must be below that, got 10",
        ),
        (DataConfig(start=5, stop=5), 10, r"data\.stop must be above data\.start 5, or 0, got 5"),
        (DataConfig(), 0, "synthetic has no frames; expected at least one"),
        (
            DataConfig(hold_out_every=2, hold_out_offset=0),
            1,
            "holding out every 2th of 1 frames leaves none to map",
        ),
        (
            DataConfig(hold_out_every=4, hold_out_offset=4),
            9,
            r"data\.hold_out_offset must be between 0 and 3 .*got 4",
        ),
    ],
)
def test_impossible_selections(config, n, pattern):
    with pytest.raises(SequenceError, match=pattern):
        apply_options(Synthetic(n), config)


@pytest.mark.parametrize(
    ("width", "height", "size"),
    [(4, 0, (4, 3)), (0, 3, (4, 3)), (2, 6, (2, 6)), (0, 0, (8, 6))],
)
def test_resize(width, height, size):
    view = apply_options(Synthetic(), DataConfig(width=width, height=height)).mapping
    frame = view[0]
    assert (view.camera.width, view.camera.height) == size
    assert frame.camera == view.camera
    assert frame.camera.cx / size[0] == 0.5  # edges stay edges
    assert set(frame.depth_m.unique().tolist()) == {0.0, 1.0}  # no depth in between at the edge


def test_depth_limits():
    view = apply_options(
        Synthetic(), DataConfig(depth_min_m=2.0, depth_max_m=4.0, hold_out_every=0)
    ).mapping
    assert float(view[1].depth_m.max()) == 2.0
    assert float(view[3].depth_m.max()) == 4.0
    for i in (0, 4):
        with pytest.raises(
            BadFrameError,
            match=rf"synthetic frame {i} has no depth between 2 and 4 m; expected some",
        ):
            view[i]
    far = apply_options(Synthetic(), DataConfig(depth_min_m=2.0, hold_out_every=0)).mapping
    assert float(far[9].depth_m.max()) == 10.0


def test_detection_lists_what_was_looked_for(tmp_path, box):
    with pytest.raises(SequenceError) as caught:
        open_sequence(tmp_path)
    message = str(caught.value)
    assert "fits no known layout; looked for" in message
    for name in known_layouts():
        assert name in message
    root = box.folder(tmp_path / "scan")
    assert detect_layout(root) == "folder"
    (root / "intrinsics.json").unlink()
    with pytest.raises(
        SequenceError, match=r"looked for folder: rgb/, .* \(missing intrinsics\.json\); "
    ):
        open_sequence(root)


def test_wrong_paths_and_names(tmp_path, box):
    with pytest.raises(SequenceNotFoundError, match="nowhere"):
        open_sequence(tmp_path / "nowhere")
    root = box.folder(tmp_path / "scan")
    with pytest.raises(KeyError, match="kitti"):
        open_sequence(root, format="kitti")
    with pytest.raises(SequenceNotFoundError, match=r"traj\.txt"):
        open_sequence(root, format="replica")


def test_who_gives_a_bag_to_map_is_sent_to_convert(tmp_path):
    (tmp_path / "a.bag").write_bytes(b"#ROSBAG V2.0")
    for path in (tmp_path / "a.bag", tmp_path):
        with pytest.raises(SequenceError, match=r"gsfusion-nb convert"):
            open_sequence(path)


def test_an_option_that_the_reader_lacks_is_named():
    with pytest.raises(ValueError, match=r"noize.*noise"):
        open_sequence("room", noize="kinect")


def test_a_recording_as_text_is_one_line(tmp_path, box):
    """Not the paths and poses of all its frames."""
    source = open_sequence(box.folder(tmp_path / "scan")).source
    size = f"{source.camera.width}x{source.camera.height}"
    assert repr(source) == f"RecordedSequence({source.name!r}, {len(source)} frames, {size})"
