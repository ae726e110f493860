"""The help of every command: each name that it gives is in its registry, each default is that of
the field."""

import dataclasses
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import tyro

from gsfusion_nb import cli
from gsfusion_nb.backends import BACKENDS, use_backend
from gsfusion_nb.cli.commands import COMMANDS
from gsfusion_nb.compare.data_sets import DATA_SETS
from gsfusion_nb.compare.studies import STUDIES
from gsfusion_nb.config import presets
from gsfusion_nb.data.open import known_layouts
from gsfusion_nb.mapping import SYSTEMS
from gsfusion_nb.recordings.convert.formats import FORMATS
from gsfusion_nb.seeding import get_rule

CALLS = [
    *[("map", "--system", system) for system in SYSTEMS],
    ("map", "--preset", "tum", "--fidelity", "code"),
    *[("live", source) for source in ("folder", "realsense")],
    *[(name,) for name in COMMANDS if name not in ("map", "live")],
    ("course", "export"),
]
FIDELITIES = {name for mapper in SYSTEMS.values() for name in mapper.description.fidelities}
NAMES = {
    "system": set(SYSTEMS),
    "systems": set(SYSTEMS),
    "preset": set(presets()),
    "fidelity": FIDELITIES,
    "format": {"auto", *known_layouts()},
    "backend": {"auto", *BACKENDS},
}
"""Option -> what it may be. Other options of the same name have their own registry:
``OWN_NAMES``."""
OWN_NAMES = {
    ("bench", "backend"): {"reference", "numba", "cuda"},
    ("bench", "what"): {"all", "raster", "tsdf", "map", "growth"},
    ("study", "name"): {*STUDIES, "errors", "roofline", "views"},
    ("benchmark", "name"): set(DATA_SETS),
    ("convert", "words"): set(FORMATS),
}


def help_of(
    arguments: tuple[str, ...], monkeypatch: pytest.MonkeyPatch, capsys: Any
) -> tuple[type, dict[str, str]]:
    """The class of a command's options, and the help of each option by its name on the command
    line."""
    classes = []
    parse = tyro.cli

    def noted(options: type, **rest: Any) -> Any:
        classes.append(options)
        return parse(options, **rest)

    monkeypatch.setattr(tyro, "cli", noted)
    monkeypatch.setenv("COLUMNS", "80")
    everything = "--help-all" if arguments[0] in ("map", "live") else "--help"
    with pytest.raises(SystemExit):
        cli.main([*arguments, everything])
    blocks: dict[str, str] = {}
    name = ""
    for line in capsys.readouterr().out.splitlines():
        inside = line.strip("│").rstrip()
        start = re.match(r" {1,2}(?:-\w(?: STR)?, )?(?:--([\w.\-]+)|\[?([A-Z]{2,}))", inside)
        if start:
            name = (start[1] or start[2].lower()).replace("-", "_")
            blocks[name] = ""
        blocks[name] = f"{blocks.get(name, '')} {inside.strip()}"
    return classes[-1], blocks


def fields_of(
    options: Any,
    path: str = "",
) -> Iterator[tuple[str, dataclasses.Field, Any]]:
    """Each option: its dotted name, its field, and its default."""
    for f in dataclasses.fields(options):
        value = f.default
        if not isinstance(options, type):
            value = getattr(options, f.name)
        elif f.default_factory is not dataclasses.MISSING:
            value = f.default_factory()
        if isinstance(value, dict) and value:
            yield from ((f"{path}{f.name}.{key}", f, each) for key, each in value.items())
        elif dataclasses.is_dataclass(value):
            flat = f.name in ("config", "options")
            yield from fields_of(value, path if flat else f"{path}{f.name}.")
        else:
            yield path + f.name, f, value


def as_shown(value: Any) -> str:
    """A default as the help writes it."""
    if value == {}:
        return ""
    if isinstance(value, tuple):
        return " ".join(str(x) for x in value)
    return str(value)


@pytest.mark.parametrize("arguments", CALLS, ids=" ".join)
def test_each_default_is_shown_and_each_name_is_known(arguments, monkeypatch, capsys):
    options, helps = help_of(arguments, monkeypatch, capsys)
    for name, f, value in fields_of(options):
        text = helps.get("format" if name == "words" else name, "")
        assert text, f"no help of {name}"
        if value is dataclasses.MISSING:
            assert "(required)" in text or name == "words", f"{name}: {text}"
            continue
        told = re.search(r"\(default: (.*?)\)( |$)", text)
        wanted = as_shown(value)
        assert (told[1] if told else "") == wanted, f"{name}: {text}"
        known = OWN_NAMES.get((arguments[0], f.name), NAMES.get(f.name))
        assert known is None or "." in name or "names" in f.metadata, name
        if "names" in f.metadata:
            names = {str(n).partition(" ")[0] for n in f.metadata["names"]()}
            listed = text.partition("Known: ")[2]
            assert {
                n for n in names if re.search(rf"(?<![\w\-]){re.escape(n)}(?![\w\-])", listed)
            } == names, text
            assert known is None or names == known


@pytest.mark.parametrize("name", sorted(NAMES["backend"]))
def test_the_help_names_backends_that_a_command_takes(name):
    with use_backend(name):
        pass


def test_the_rules_that_a_text_names_are_registered():
    text = (Path(cli.__file__).parents[1] / "config/parts.py").read_text(encoding="utf-8")
    named = text.partition('"""Name of a registered seeding rule: ')[2].partition(", another one")[
        0
    ]
    assert len(named.split(", ")) == 5
    for rule in named.split(", "):
        get_rule(rule)


def test_every_command_is_in_the_first_help(capsys):
    assert cli.main(["--help"]) == 0
    shown = set(re.findall(r"• (\w+)", capsys.readouterr().out))
    assert shown == set(COMMANDS)
