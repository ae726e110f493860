"""The roofline: the formula, what is counted, and that every kernel is timed on every CPU
backend."""

import functools

import pytest
import torch

from gsfusion_nb.compare import roofline
from gsfusion_nb.compare import studies as run
from gsfusion_nb.compare.kernel_work import mapping_work
from gsfusion_nb.compare.roofline import (
    KernelPoint,
    Roofs,
    as_table,
    fastest_s,
    kernel_points,
    measure_roofs,
    roofline_figure,
)

ROOFS = Roofs(gflops=100.0, gb_per_s=10.0)


def test_the_roof_by_hand():
    assert ROOFS.ridge == 10.0
    assert [ROOFS.attainable_gflops(i) for i in (0.5, 10.0, 50.0)] == [5.0, 100.0, 100.0]


def test_a_point_by_hand():
    point = KernelPoint(name="k", backend="numba", flops=2e9, bytes=1e9, seconds=0.5)
    assert (point.intensity, point.gflops) == (2.0, 4.0)
    line = as_table(ROOFS, [point]).splitlines()[1]
    assert "20 %" in line
    assert line.endswith("memory")


def test_the_clock_takes_the_fastest_after_a_first_run():
    calls = []
    assert fastest_s(lambda: calls.append(1), repeats=3) > 0
    assert len(calls) == 4


def test_measured_roofs_are_those_of_a_computer():
    roofs = measure_roofs(size=128, megabytes=4)
    assert 0.1 < roofs.gflops < 10_000
    assert 0.1 < roofs.gb_per_s < 10_000


def test_every_operation_on_every_backend():
    points = kernel_points(lambda: mapping_work(200, 48, 32), repeats=1)
    names = [w.name for w in mapping_work(200, 48, 32)]
    for backend in ("reference", "numba"):
        assert [p.name for p in points if p.backend == backend] == names
    adam = points[names.index("Adam")]
    assert adam.intensity == pytest.approx(12 / 28)
    figure = roofline_figure(ROOFS, points)
    assert figure.axes[0].get_legend_handles_labels()[1] == ["reference", "numba"]
    assert len(roofline_figure(ROOFS, []).axes) == 1


def test_the_command_writes_a_table_and_a_picture(tmp_path, monkeypatch, capsys):
    small = functools.partial(mapping_work, 200, 48, 32)
    monkeypatch.setattr(roofline, "mapping_work", small)
    monkeypatch.setattr(roofline, "measure_roofs", lambda: ROOFS)
    assert run.study(run.StudyOptions(name="roofline", out=str(tmp_path))) == 0
    text = (tmp_path / "roofline.txt").read_text()
    assert "100 Gflop/s (matrix product), 10 GB/s" in text
    assert text.strip() in capsys.readouterr().out
    assert all(
        text.count(name) >= 2 for name in ("L1 and gradient", "TSDF update", "render, gradient")
    )
    assert (tmp_path / "roofline.png").read_bytes()[1:4] == b"PNG"


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
@pytest.mark.parametrize(
    ("device", "reason"), [("cuda", "needs an NVIDIA GPU"), ("gpu", "must be cpu or cuda")]
)
def test_a_device_that_is_not_there_is_named(device, reason, tmp_path):
    with pytest.raises(ValueError, match=reason):
        roofline.main(device, tmp_path)
