import json

import pytest

from gsfusion_nb.compare.bench import Row, table
from gsfusion_nb.compare.bench.rows import with_speed
from gsfusion_nb.compare.bench.timing import Timing


def row(method, cpu_ms, wall_ms=None, case="20k 640x480 SH3 fwd+bwd", **more):
    timing = Timing(wall_ms=wall_ms or cpu_ms, cpu_ms=cpu_ms, runs=3, peak_mb=12.4)
    return Row(section=more.pop("section", "raster"), case=case, method=method, timing=timing, **more)


ROWS = [
    row("gsplat (torch path)", 7323.4, note="131 dB 1.0000"),
    row("reference", 1100.0),
    row("numba", 61.25, wall_ms=122.5, note="118 dB 1.0000", values={"psnr_to_torch_db": 118.0}),
    row("reference", 33.0, case="redkitchen250 640x480 1 cm", section="tsdf", note="10 frames/s"),
]
MISSING = {"tsdf": {"Open3D VoxelBlockGrid": "not installed: pip install open3d"}}


def test_speed_is_relative_to_the_first_row_of_the_case():
    one = with_speed(ROWS, threads=1)
    assert [r.speed for r in one] == pytest.approx([1, 7323.4 / 1100, 7323.4 / 61.25, 1])
    two = with_speed(ROWS, threads=2)
    assert two[2].speed == pytest.approx(7323.4 / 122.5)


def test_a_row_without_time_is_no_base():
    failed = Row(section="raster", case="a", method="program", note="needs 2 GB, 1 free")
    rows = with_speed([failed, row("reference", 10.0, case="a"), row("numba", 5.0, case="a")], threads=1)
    assert [r.speed for r in rows] == [None, 1, 2]
    assert "needs 2 GB" in table.text(rows, {})


def test_text_fits_a_terminal_of_100_columns_and_names_what_is_missing():
    text = table.text(with_speed(ROWS, 1), MISSING)
    assert max(len(line) for line in text.splitlines()) <= 100
    assert "Open3D VoxelBlockGrid: not installed: pip install open3d" in text
    numba = next(line for line in text.splitlines() if " numba " in line)
    assert numba.split() == ["numba", "122", "61.2", "120x", "12", "3", "118", "dB", "1.0000"]
    assert text.count("20k 640x480 SH3 fwd+bwd") == 1  # named once, then indented below


def test_markdown_has_as_many_cells_in_every_line_of_a_table():
    text = table.markdown(with_speed(ROWS, 1), MISSING)
    lines = [line for line in text.splitlines() if line.startswith("|")]
    assert {line.count("|") for line in lines} == {9}
    assert "pip install open3d" in text


def test_parts_of_a_case_are_indented_under_it():
    rows = [row("auto", 50.0, case="room", section="map"), row("auto", 20.0, case="room / TSDF", section="map")]
    assert "\n    TSDF" in table.text(with_speed(rows, 1), {})


def test_plain_values_survive_json():
    again = json.loads(json.dumps([table.plain(r) for r in with_speed(ROWS, 1)]))
    assert again[2]["timing"]["wall_ms"] == 122.5
    assert again[2]["values"] == {"psnr_to_torch_db": 118.0}


@pytest.mark.parametrize(("x", "text"), [(0.0123, "0.01"), (9.876, "9.88"), (45.67, "45.7"), (12345.6, "12346")])
def test_numbers(x, text):
    assert table.number(x) == text
