"""ScanNet++ in the nerfstudio layout."""

import pytest
import torch
from published_layouts import TEST, TRAIN
from published_layouts import scannetpp_layout as write

from gsfusion_nb.config import DataConfig
from gsfusion_nb.data import SequenceError, SequenceNotFoundError, open_sequence, scannetpp


def test_reads_what_was_written(tmp_path, box):
    seq = scannetpp(write(tmp_path / "8b5caf3398", box))
    assert (seq.name, len(seq)) == ("8b5caf3398", 4)
    assert seq.camera == box.camera  # edge pixel centres: nothing added
    for frame, name in zip(seq, [*TRAIN, *TEST], strict=True):
        assert torch.allclose(
            frame.T_WC.double(),
            box.poses(6)[int(name[3:8])],
            atol=1e-6,
        )
        assert box.off_wall_m(frame) < 0.0005
    assert seq.novel == {3}
    assert len(scannetpp(tmp_path / "8b5caf3398" / "dslr")) == 4


def test_splits(tmp_path, box):
    root = write(tmp_path / "scene", box)
    train = scannetpp(root, split="train")
    test = scannetpp(root, split="test")
    assert [p.name for p in train.rgb_files] == TRAIN
    assert [p.name for p in test.rgb_files] == TEST
    with pytest.raises(SequenceError, match="split must be train, test or all, got 'val'"):
        scannetpp(root, split="val")  # pyright: ignore[reportArgumentType]


def test_open_sequence_holds_the_published_test_views_out(tmp_path, box):
    root = write(tmp_path / "scene", box)
    seq = open_sequence(root, data=DataConfig(hold_out_every=0))
    assert [f.index for f in seq.mapping] == [0, 1, 2]
    assert [f.index for f in seq.held_out] == [3]
    seq = open_sequence(root, data=DataConfig(hold_out_every=3, hold_out_offset=1))
    assert [f.index for f in seq.mapping] == [0, 2]
    assert [f.index for f in seq.held_out] == [1, 3]
    assert len(open_sequence(root, split="train", data=DataConfig(hold_out_every=0)).held_out) == 0
    assert len(open_sequence(root, split="test", data=DataConfig(hold_out_every=0)).mapping) == 1


def test_resolutions(tmp_path, box):
    root = write(tmp_path / "scene", box)
    write(root, box, suffix="", fl_x=2 * box.camera.fx)
    assert scannetpp(root).camera.fx == box.camera.fx  # the half-resolution variant is preferred
    assert scannetpp(root, resolution="full").camera.fx == 2 * box.camera.fx
    assert scannetpp(root, resolution="full").rgb_files[0].parent.name == "undistorted_images"
    only_full = write(tmp_path / "other", box, suffix="")
    assert len(scannetpp(only_full)) == 4
    with pytest.raises(
        SequenceNotFoundError,
        match=r"transforms_undistorted_2\.json does not exist.*half resolution",
    ):
        scannetpp(only_full, resolution="half")


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("fl_x", None),
        ("w", 63.5),
        ("frames", None),
        ("frames", []),
        ("frames", [{"file_path": "a.JPG"}]),
        ("frames", [{"file_path": "a.JPG", "transform_matrix": [[1]]}]),
        ("k1", 0.01),
        ("camera_model", "FISHEYE"),
    ],
)
def test_bad_json(tmp_path, box, key, value):
    with pytest.raises(SequenceError, match=r"transforms_undistorted_2\.json"):
        scannetpp(write(tmp_path / "scene", box, **{key: value}))
