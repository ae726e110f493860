"""HTML from templates: what is not HTML is escaped, what is stays, and a forgotten value is an error."""

import pytest
from jinja2 import UndefinedError
from markupsafe import Markup

from gsfusion_nb.drawing.page import fill, html_table


def test_texts_are_escaped_and_markup_is_not():
    html = html_table([("<a>", Markup("<b>x</b>"))], heads=("1 < 2", "&"))
    assert "&lt;a&gt;" in html
    assert "<b>x</b>" in html
    assert "1 &lt; 2" in html
    assert "&amp;" in html
    assert "<a>" not in html


def test_styles_of_cells_are_those_of_headings_unless_said():
    html = html_table([("a",)], heads=("h",), cell_style="color:red")
    assert html.count('style="color:red"') == 2
    html = html_table([("a",)], heads=("h",), cell_style="color:red", head_style="")
    assert html.count('style="color:red"') == 1
    assert "<th>h</th>" in html


def test_the_foot_goes_across_all_columns():
    html = html_table([("a", "b", "c")], heads=("1", "2", "3"), foot="2 more", name="gsnb-x", style="font-size:9px")
    assert 'colspan="3"' in html
    assert '<table class="gsnb-x" style="font-size:9px">' in html
    assert html.endswith("</table>")


def test_a_value_that_is_not_given_is_an_error():
    with pytest.raises(UndefinedError, match="'verdict' is undefined"):
        fill("verdict.html", colour="red")
