"""Chapter 5's checkers, and the table that compares a gradient three ways."""

from pathlib import Path

import pytest
import torch

import gsfusion_nb
from gsfusion_nb.course import hand_written_gradients
from gsfusion_nb.course.gradients import central_difference, compare_gradients
from gsfusion_nb.course.source_lines import source_lines
from gsfusion_nb.render import project_gaussians

F64 = torch.float64
X = torch.tensor([0.3, -1.2, 2.0], dtype=F64)


def test_central_difference_of_a_cubic():
    """d/dx x^3 = 3 x^2, and the central difference is off by exactly h^2."""
    got = central_difference(lambda x: float((x**3).sum()), X, 0.1)
    torch.testing.assert_close(got, 3 * X**2 + 0.01)


def test_three_ways_agree_on_a_right_gradient():
    table = compare_gradients(
        torch.sin,
        lambda v, x: v * x.cos(),
        {"x": X},
    )
    assert table
    assert "all three agree" in repr(table)


def test_three_ways_find_one_wrong_element():
    def almost(v, x):
        g = v * x.cos()
        g[2] *= 1.001
        return g

    table = compare_gradients(torch.sin, almost, {"x": X})
    assert not table
    assert "do NOT agree" in repr(table)


def test_three_ways_name_the_input_that_is_wrong():
    table = compare_gradients(
        lambda a, b: a * b,
        lambda v, a, b: (v * b, v * b),
        {"a": X, "b": X + 1},
    )
    assert [max(row.errors) < 1e-5 for row in table.rows] == [True, False]


def test_an_input_without_influence_has_zero_gradient():
    table = compare_gradients(
        lambda a, b: a * 2,
        lambda v, a, b: (2 * v, torch.zeros_like(b)),
        {"a": X, "b": X},
    )
    assert table


def test_all_solutions_pass_three_ways():
    v_C = torch.tensor([0.3, -1.0, 0.5], dtype=F64)
    alpha = torch.tensor([0.5, 0.8, 0.3], dtype=F64)
    rgb = torch.rand(3, 3, dtype=F64)
    assert compare_gradients(
        hand_written_gradients._blend,
        lambda v, a, c: hand_written_gradients._blend_vjp(a, c, v),
        {"alpha": alpha, "rgb": rgb},
        v=v_C,
    )
    cov = torch.tensor([[2.0, 0.8], [0.8, 1.0]], dtype=F64)
    assert compare_gradients(
        torch.linalg.inv,
        lambda v, s: hand_written_gradients._inverse_vjp(s.inverse(), v),
        {"cov": cov},
    )

    def pinhole(p):
        return torch.stack([90 * p[0] / p[2], 110 * p[1] / p[2]])

    assert compare_gradients(
        pinhole,
        lambda v, p: hand_written_gradients._pinhole_vjp(p, 90.0, 110.0, v),
        {"p": X},
    )


def test_source_lines_find_a_line_with_its_number(monkeypatch):
    monkeypatch.chdir(Path(gsfusion_nb.__file__).parents[1] / "notebooks")
    lines = source_lines({"u": (project_gaussians, "u = camera.fx")})
    _, code, path, number = lines.rows[0]
    assert code.startswith("u = camera.fx * s.x / s.z + camera.cx")
    assert path == "gsfusion_nb/render/project.py"
    assert f"{path}:{number}" in repr(lines)
    assert f'href="../{path}#line={number - 1}"' in lines._repr_html_()


@pytest.mark.parametrize(("piece", "count"), [("no such words", 0), ("torch.stack", "[0-9]+")])
def test_source_lines_refuse_what_is_not_unique(piece, count):
    with pytest.raises(ValueError, match=f"must be on one line of project.py, it is on {count}"):
        source_lines({"x": (project_gaussians, piece)})
