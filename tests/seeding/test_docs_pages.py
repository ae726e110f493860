"""The pages about seeding name every built-in rule and everything that a rule may read."""

import dataclasses
import inspect
import re
from pathlib import Path

import pytest

from gsfusion_nb.seeding import MapView, SeedContext, is_built_in, registered

DOCS = Path(__file__).resolve().parents[2] / "docs"
FOR_THE_PACKAGE = {"reading", "results", "gaussians"}
"""Parts of a context by which its other parts are computed; ``map`` has what a rule may know of the
Gaussians."""


@pytest.mark.parametrize("kind", [SeedContext, MapView])
def test_the_page_on_the_context_names_all_that_there_is(kind):
    page = (DOCS / "seeding_context.md").read_text(encoding="utf-8")
    words = set(re.findall(r"\w+", " ".join(re.findall(r"`([^`]+)`", page))))
    names = {field.name for field in dataclasses.fields(kind)} | {
        name for name, _ in inspect.getmembers(kind)
    }
    public = {name for name in names if not name.startswith("_")}
    assert public - words - FOR_THE_PACKAGE == set()


def test_the_tables_have_every_built_in_rule_and_its_file():
    page = (DOCS / "seeding_rules.md").read_text(encoding="utf-8")
    rows = re.findall(
        r"^\| \[`(\w+)`\]\(\.\./(gsfusion_nb/seeding/rules/\w+\.py)\)", page, re.MULTILINE
    )
    built_in = {name: rule for name, rule in registered().items() if is_built_in(rule)}
    assert sorted(name for name, _ in rows) == sorted(built_in)
    for name, file in rows:
        module = inspect.unwrap(built_in[name]).__module__
        assert file == f"{module.replace('.', '/')}.py", name
