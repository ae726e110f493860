import os

import pytest

from gsfusion_nb.compare.bench import BenchOptions


def test_defaults():
    options = BenchOptions()
    options.check()
    assert options.sections == ("raster", "tsdf", "map", "panels", "latency", "checkpoints")
    assert options.sizes == [(320, 240)]
    assert options.n_frames == 60
    assert BenchOptions(quick=True).n_frames == 8
    assert BenchOptions(data="somewhere").sizes == [(0, 0)]
    assert BenchOptions(size=("64x48", "640X480")).sizes == [(64, 48), (640, 480)]


@pytest.mark.parametrize(
    ("changes", "error", "sentence"),
    [
        (
            {"what": "rastre"},
            KeyError,
            "no bench 'rastre'; known: all, checkpoints, latency, map, panels, raster, tsdf",
        ),
        ({"backend": ("cuda", "numa")}, KeyError, "no backend .numa.; known: cuda, numba, reference, torch.$"),
        ({"threads": 0}, ValueError, f"between 1 and {os.cpu_count()}, the cores of this machine, got 0"),
        ({"frames": 1}, ValueError, "--frames must be at least 2"),
        ({"frames": -3}, ValueError, "--frames must be at least 2"),
        ({"size": ("640",)}, ValueError, "--size must look like 320x240, got '640'"),
        ({"size": ("8x8",)}, ValueError, "--size must be at least 32x32, got 8x8"),
        ({"json": "/no/such/place/x.json"}, ValueError, "/no/such/place is not a folder"),
        ({"json": "/"}, ValueError, "is a folder; expected the name of a file"),
    ],
)
def test_what_makes_no_sense_is_refused_before_anything_runs(changes, error, sentence):
    with pytest.raises(error, match=sentence):
        BenchOptions(**changes).check()
