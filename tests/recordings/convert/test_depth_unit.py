"""The unit of stored depth."""

import numpy as np
import pytest

from gsfusion_nb.data import SequenceError
from gsfusion_nb.recordings.convert.depth_unit import find_depth_unit


def depths(near_m, far_m, scale):
    """A depth image from ``near_m`` to ``far_m`` as stored."""
    values = np.linspace(near_m, far_m, 4096) * scale
    return [np.rint(values).astype(np.uint16).astype(np.float32).reshape(64, 64)]


@pytest.fixture
def folder(tmp_path):
    """``folder(name)`` makes a folder."""

    def make(name):
        (tmp_path / name).mkdir()
        return tmp_path / name

    return make


def test_the_range_decides_where_only_one_unit_gives_plausible_depths(folder):
    assert find_depth_unit(folder("scan"), depths(0.6, 2.0, 1000))[0] == 1000
    assert find_depth_unit(folder("other"), depths(1.0, 4.0, 5000))[0] == 5000


def test_what_nothing_decides_is_asked_for(folder):
    unclear = depths(2.0, 4.5, 1000)  # or 0.4 to 0.9 m with 5000
    with pytest.raises(SequenceError, match="give --depth-scale"):
        find_depth_unit(folder("scan"), unclear)
    assert find_depth_unit(folder("rgbd_dataset_freiburg1_x"), unclear)[0] == 5000


def test_whole_metres_have_lost_their_precision(folder):
    with pytest.raises(SequenceError, match=r"whole metres up to 4, so precision was lost .* export depth again"):
        find_depth_unit(folder("scan"), depths(0.6, 4.0, 1))


def test_no_plausible_unit_is_asked_for(folder):
    with pytest.raises(SequenceError, match="give --depth-scale"):
        find_depth_unit(folder("scan"), depths(0.02, 0.1, 1000))
    with pytest.raises(SequenceError, match="hold no depth"):
        find_depth_unit(folder("empty"), [np.zeros((4, 4), np.float32)])
