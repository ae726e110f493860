"""Rules from files: options and source; what a file registers stays in it; mistakes with file and
line."""

import pytest

from gsfusion_nb.code_keys import rule_fingerprint
from gsfusion_nb.seeding import is_built_in, registered, rule_options, rule_source
from gsfusion_nb.seeding.code_files import file_source, is_code_file
from gsfusion_nb.seeding.rule_code import find_rule, load_rule_file, rule_of_source

FILE = '''"""Two rules."""
from dataclasses import dataclass
from gsfusion_nb.seeding import MapRule, seeding_rule

def _half(pixels):
    return pixels[::2]

@seeding_rule
def uniform(ctx, *, step=3):
    return ctx.seeds_at(_half(ctx.pixels()), 1.0)

@seeding_rule
@dataclass(frozen=True, kw_only=True)
class every_other(MapRule):
    step: int = 2

    def seeds(self, ctx, memory):
        return ctx.seeds_at(ctx.pixels()[::self.step], 1.0)
'''


@pytest.fixture
def path(tmp_path):
    file = tmp_path / "mine.py"
    file.write_text(FILE)
    return file


def test_a_rule_of_a_file(path):
    before = registered()
    rule = load_rule_file(f"{path}:uniform")
    assert rule_options(rule) == {"step": 3}
    assert registered() == before
    assert find_rule("uniform") is before["uniform"]
    assert find_rule(f"{path}:uniform") is rule
    assert not is_built_in(rule)
    assert "def uniform(ctx, *, step=3)" in rule_source(rule)
    assert file_source(rule) == FILE
    assert file_source(find_rule("uniform")) == ""
    cls = rule_of_source(FILE, "every_other")
    assert rule_options(cls) == {"step": 2}
    assert "class every_other(MapRule)" in rule_source(cls)


def test_the_same_source_is_the_same_rule_wherever_it_comes_from(path):
    rule = load_rule_file(f"{path}:uniform")
    assert rule_fingerprint(rule) == rule_fingerprint(
        rule_of_source(FILE, "uniform", "elsewhere/rule.py")
    )
    edited = rule_of_source(FILE.replace("[::2]", "[::4]"), "uniform")
    assert rule_fingerprint(edited) != rule_fingerprint(rule)


@pytest.mark.parametrize(
    ("source", "name", "message"),
    [
        (
            FILE,
            "uniforn",
            r"mine.py has no seeding rule 'uniforn'; it defines: uniform, every_other",
        ),
        ("x = 1 +\n", "a", r"mine.py, line 1: SyntaxError: invalid syntax"),
        ("import torch\nx = 1 / 0\n", "a", r"mine.py, line 2: ZeroDivisionError: division by zero"),
        ("a = 3\n", "a", r"mine.py has no seeding rule 'a'; it defines: none"),
    ],
)
def test_mistakes_name_the_file_and_the_line(path, source, name, message):
    path.write_text(source)
    with pytest.raises(ValueError, match=message):
        load_rule_file(f"{path}:{name}")


def test_names_of_rules_and_files(path):
    assert is_code_file("a/b.py:c")
    assert not is_code_file("uniform")
    with pytest.raises(ValueError, match=r"FILE\.py:name"):
        find_rule(str(path))
    with pytest.raises(FileNotFoundError, match="expected the file of the seeding rule a"):
        find_rule("nowhere.py:a")
    path.write_text("def a(ctx, n):\n    return None\n")
    with pytest.raises(TypeError, match="must be keyword-only"):
        find_rule(f"{path}:a")
