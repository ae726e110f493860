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


def test_a_value_that_is_not_given_is_an_error():
    with pytest.raises(UndefinedError, match="'verdict' is undefined"):
        fill("verdict.html", colour="red")
