"""A reader is added with one file in ``data/readers``: nothing else knows the layouts by name."""

from pathlib import Path

import numpy as np
import pytest

from gsfusion_nb import data
from gsfusion_nb.data import SequenceError, detect_layout, layouts, open_sequence, readers

PACKAGE = Path(data.__file__).parents[1]

TOY_READER = """
import numpy as np
import torch

from ...types import Camera, Frame
from ..recorded.files import require
from ..recorded.recorded_sequence import Layout

LOOKS_FOR = ("toy.npz",)


class ToySequence:
    def __init__(self, path):
        self.name, self._arrays = path.name, np.load(path / "toy.npz")
        height, width = self._arrays["depth_m"].shape[1:]
        self.camera = Camera(width=width, height=height, fx=32.0, fy=32.0, cx=width / 2, cy=height / 2)

    def __len__(self):
        return len(self._arrays["depth_m"])

    def pose(self, i):
        return torch.from_numpy(self._arrays["T_WC"][i])

    def __getitem__(self, i):
        if not 0 <= i < len(self):
            raise IndexError(i)
        rgb, depth_m = (torch.from_numpy(self._arrays[name][i]) for name in ("rgb", "depth_m"))
        return Frame(index=i, timestamp_s=0.1 * i, rgb=rgb, depth_m=depth_m, camera=self.camera, T_WC=self.pose(i))


def toy(path, *, skip: int = 0):
    require(path, LOOKS_FOR, "toy")
    return ToySequence(path)


LAYOUT = Layout(read=toy, looks_for=LOOKS_FOR)
"""


@pytest.fixture
def toy_reader(tmp_path, monkeypatch):
    (tmp_path / "readers").mkdir()
    (tmp_path / "readers/toy.py").write_text(TOY_READER)
    monkeypatch.setattr(readers, "__path__", [*readers.__path__, str(tmp_path / "readers")])


@pytest.fixture
def recording(tmp_path):
    root = tmp_path / "scan"
    root.mkdir()
    T_WC = np.tile(np.eye(4, dtype=np.float32), (3, 1, 1))
    np.savez(
        root / "toy.npz",
        rgb=np.full((3, 24, 32, 3), 0.5, np.float32),
        depth_m=np.full((3, 24, 32), 2.0, np.float32),
        T_WC=T_WC,
    )
    return root


@pytest.mark.usefixtures("toy_reader")
def test_one_file_adds_a_reader(recording, tmp_path):
    assert {"folder", "replica", "scannetpp", "seven_scenes", "toy", "tum"} <= set(layouts())
    assert detect_layout(recording) == "toy"
    for found in (open_sequence(recording), open_sequence(recording, format="toy", skip=1)):
        assert len(found) == 3
        assert float(found[1].depth_m.max()) == 2.0
    with pytest.raises(SequenceError, match=r"toy: toy\.npz \(missing toy\.npz\)"):
        detect_layout(tmp_path / "readers")
    with pytest.raises(SequenceError, match="'toy' layout has no split"):
        open_sequence(recording, split="test")


def test_without_the_file_the_layout_is_unknown(recording):
    assert "toy" not in layouts()
    with pytest.raises(SequenceError, match="fits no known layout"):
        open_sequence(recording)


def test_only_readers_and_what_writes_their_layouts_name_a_layout():
    """``seven_scenes`` stands for all: its name means nothing else."""
    named = {p.relative_to(PACKAGE).as_posix() for p in PACKAGE.rglob("*.py") if "seven_scenes" in p.read_text("utf-8")}
    assert named == {
        "data/__init__.py",
        "data/open.py",
        "data/readers/__init__.py",
        "data/readers/seven_scenes.py",
        "recordings/room_layouts.py",
    }
