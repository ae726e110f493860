"""The pages about seeding name every built-in rule and everything that a rule may read."""

import dataclasses
import inspect
import re
from pathlib import Path

import pytest

from gsfusion_nb.seeding import MapView, SeedContext, is_built_in, registered

DOCS = Path(__file__).resolve().parents[2] / "docs"
RULES = [name for name, rule in registered().items() if is_built_in(rule)]


def public_names(kind: type) -> list[str]:
    names = {field.name for field in dataclasses.fields(kind)} | {name for name, _ in inspect.getmembers(kind)}
    return sorted(name for name in names if not name.startswith("_"))


@pytest.mark.parametrize(("kind", "prefix"), [(SeedContext, ""), (MapView, r"\.")])
def test_the_page_on_the_context_names_all_that_there_is_and_nothing_else(kind, prefix):
    page = (DOCS / "seeding_context.md").read_text(encoding="utf-8")
    rows = re.findall(rf"^\| `{prefix}(\w+)", page, re.MULTILINE)
    assert sorted(rows) == public_names(kind)


def test_the_table_has_every_built_in_rule():
    page = (DOCS / "seeding_rules.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| \[`(\w+)`\]\(\.\./gsfusion_nb/seeding/rules/(\w+)\.py\)", page, re.MULTILINE)
    assert sorted(name for name, _ in rows) == sorted(RULES)
    assert all(name == file for name, file in rows)
