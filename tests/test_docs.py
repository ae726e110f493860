"""What README and docs name exists: links, images, files, make targets, commands with their
options, Python imports."""

import ast
import contextlib
import dataclasses
import io
import json
import re
import shlex
from pathlib import Path

import pytest
import tyro
from egg_package import write_metadata

from gsfusion_nb import cli
from gsfusion_nb.compare.data_sets import data_set_of
from gsfusion_nb.config import gsfusion, replace, to_dict
from gsfusion_nb.config.options import parse_value
from gsfusion_nb.config.values import leaves
from gsfusion_nb.mapping import SYSTEMS, get_system, systems
from gsfusion_nb.seeding.rule import keep_registered

ROOT = Path(__file__).resolve().parents[1]
PAGES = sorted(
    [
        *ROOT.glob("*.md"),
        *(ROOT / "docs").glob("*.md"),
        *(ROOT / "docs/teaching").glob("*.md"),
        *(ROOT / "docs/measured").glob("*.md"),
    ]
)
COMMANDS = (
    "demo",
    "convert",
    "check",
    "map",
    "live",
    "locate",
    "eval",
    "export",
    "lab",
    "sweep",
    "study",
    "bench",
    "doctor",
    "course",
    "grade",
)
OTHER_PROGRAMS = ("--pdf", "--pdb")

BLOCK = re.compile(r"^```(\w*)\n(.*?)^```", re.MULTILINE | re.DOTALL)
INLINE = re.compile(r"`([^`\n]+)`")
LINK = re.compile(r"!?\[[^\]]*\]\(([^)\s]+)\)")


def text(page: Path) -> str:
    return page.read_text(encoding="utf-8")


def blocks(page: Path, language: str) -> list[str]:
    return [body for name, body in BLOCK.findall(text(page)) if name == language]


def code(page: Path) -> list[str]:
    """Lines of code blocks without their comments, and the code inside sentences."""
    lines = [line.split(" #")[0].strip() for body in blocks(page, "") for line in body.splitlines()]
    return lines + [span.strip() for span in INLINE.findall(BLOCK.sub("", text(page)))]


def anchors(page: Path) -> set[str]:
    """Targets that a code host makes of the headings."""
    titles = re.findall(r"^#+ (.+)$", BLOCK.sub("", text(page)), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles}


def commands(page: Path) -> list[str]:
    """Whole calls of ``gsfusion-nb``; ``a|b`` and ``...`` stand for more than one call."""
    found = [
        c[c.index("gsfusion-nb") :] for c in code(page) if re.match(r"(\w+=\w+ )?gsfusion-nb ", c)
    ]
    return [c for c in found if "..." not in c and "|" not in c]


def help_of(*arguments: str) -> str:
    out = io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.suppress(SystemExit):
        everything = arguments[:1] in (("map",), ("live",)) and arguments != ("live",)
        cli.main([*arguments, "--help-all" if everything else "--help"])
    return out.getvalue()


class Parsed(BaseException):
    """The command line was understood; nothing is to run."""


@pytest.fixture
def dry(monkeypatch):
    """Commands end where their arguments have been parsed; each name must be one that its registry
    has."""
    parse = tyro.cli

    def parse_only(*args, **kwargs):
        options = parse(*args, **kwargs)
        if kwargs.get("return_unknown_args"):  # the rest is parsed after it
            return options
        for f in dataclasses.fields(options):
            value = getattr(options, f.name)
            for each in value if isinstance(value, tuple) else (value,):
                known = (
                    [name.partition(" ")[0] for name in f.metadata["names"]()]
                    if "names" in f.metadata
                    else [each]
                )
                is_file = f.name in ("system", "systems") and ".py:" in str(each)
                if f.name == "words" or is_file or not each or each in known:
                    continue
                if f.name == "name" and ".toml:" in each:
                    data_set_of(f"{ROOT}/{each}")
                    continue
                if not each.isupper():
                    raise ValueError(f"{f.name} {each} is none of {known}")
        raise Parsed

    monkeypatch.setattr(tyro, "cli", parse_only)


@pytest.fixture
def own_systems(tmp_path, monkeypatch):
    """The systems that pages name: the example in a file, also in the folder of a run, the class
    that a page shows, and the package with an entry point."""
    example = text(ROOT / "docs/examples/splatam_like.py")
    (tmp_path / "splatam_like.py").write_text(example, encoding="utf-8")
    (tmp_path / "mine.py").write_text(blocks(ROOT / "docs/own_system.md", "python")[0])
    (tmp_path / "RUN").mkdir()
    (tmp_path / "RUN/system.py").write_text(example, encoding="utf-8")
    about = {"system": "SplatamLike", "system_from_file": True}
    config = {
        "config": to_dict(get_system(f"{tmp_path}/splatam_like.py:SplatamLike").config_type())
    }
    (tmp_path / "RUN/config.json").write_text(json.dumps(about | config))
    monkeypatch.setattr(systems, "_NAMES", dict(systems._NAMES))
    monkeypatch.setattr(systems, "_REGISTERED", dict(systems._REGISTERED))
    monkeypatch.syspath_prepend(str(write_metadata(tmp_path / "site")))
    with keep_registered():
        yield


@pytest.fixture(scope="module")
def known_options() -> set[str]:
    """Every option of every command and of the scripts that fetch data sets."""
    systems = [("map", "--system", name) for name in ("rtg_slam", "gps_slam")]
    calls = [(name,) for name in COMMANDS] + systems
    calls += [("course", "times"), ("course", "export")]
    calls += [("live", source) for source in ("folder", "realsense", "kinect")]
    scripts = (ROOT / "gsfusion_nb/recordings/fetch.py").read_text()
    return set(
        re.findall(r"--[\w][\w.\-]*", "".join(help_of(*call) for call in calls) + scripts)
    ) | set(OTHER_PROGRAMS)


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.name)
def test_links_and_images_lead_somewhere(page):
    for target in LINK.findall(BLOCK.sub("", text(page))):
        if "://" in target:
            continue
        name, _, anchor = target.partition("#")
        path = (page.parent / name).resolve() if name else page
        assert path.exists(), f"{page.name} links to {target}, which does not exist"
        assert not anchor or anchor in anchors(path), (
            f"{page.name} links to {target}, but has no such heading"
        )


def test_every_page_is_in_the_index_of_its_folder():
    for page in PAGES:
        index = ROOT / "docs/index.md" if page.parent == ROOT else page.parent / "index.md"
        link = f"(../{page.name})" if page.parent == ROOT else f"({page.name})"
        assert page.name in ("index.md", "README.md") or link in text(index), (
            f"{page.name} is not in {index}"
        )


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.name)
def test_files_that_are_named_exist(page):
    inside = r"(?<![\w/])(?:gsfusion_nb|kernels|tests|data_scripts|notebooks)/[\w/.*]*\w"
    for span in code(page):
        for name in re.findall(inside, span):
            assert any(ROOT.glob(name)), f"{page.name} names {name}, which does not exist"


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.name)
def test_make_targets_that_are_named_exist(page):
    targets = set(re.findall(r"^(\w+):", text(ROOT / "Makefile"), re.MULTILINE))
    for span in code(page):
        for target in re.findall(r"^make (\w+)", span):
            assert target in targets, f"{page.name}: no target {target} in the Makefile"


def _write_run(folder: Path) -> None:
    """The files of a run that say which settings another goes on with."""
    folder.mkdir(parents=True, exist_ok=True)
    document = {"source": {}, "config": to_dict(gsfusion()), "sha256": {}}
    for name in ("config.json", "metrics.json"):
        (folder / name).write_text(json.dumps(document))
    for name in ("places.npz", "state.zip"):
        (folder / name).touch()


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.name)
def test_commands_are_understood(page, dry, own_systems, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "FILE").write_text(
        json.dumps({"config": to_dict(gsfusion())} | to_dict(gsfusion()))
    )
    for command in set(commands(page)):
        if "--onto " in command:
            _write_run(tmp_path / command.partition("--onto ")[2].split()[0])
        arguments = shlex.split(command)[1:]
        try:
            status = cli.main(arguments)
        except Parsed:
            status = 0
        except SystemExit as e:
            status = e.code
        assert status == 0, f"{page.name}: {command}"


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.name)
def test_options_that_are_named_exist(page, known_options):
    for span in code(page):
        if span.startswith("--"):
            for option in re.findall(r"--[\w][\w.\-]*", span):
                assert option in known_options, (
                    f"{page.name} names the option {option}, which no command has"
                )


CALLS = [
    *[["map", "room", "--system", system] for system in SYSTEMS],
    ["live", "folder", "scan"],
    ["check", "DATA"],
    ["convert", "SOURCE", "OUT"],
    ["excerpt", "DATA", "OUT"],
    ["sweep", "room"],
    ["study", "systems"],
    ["benchmark", "tum", "DIR"],
    ["lab", "TABLE"],
    ["export", "RUN", "OUT"],
    ["course", "DIR"],
    ["eval", "RUN"],
    ["locate", "RUN", "DATA"],
    ["bench"],
    ["demo"],
    ["grade", "DIR"],
]
"""One call of each command to which an option of a sentence may belong."""


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.name)
def test_values_of_options_are_understood(page, dry, capsys):
    for span in code(page):
        words = shlex.split(span) if span.startswith("--") and "..." not in span else []
        if len(words) < 2 or words[1].startswith("--") or words[0] in OTHER_PROGRAMS:
            continue
        refused = []
        for call in CALLS:
            try:
                status = cli.main([*call, *words])
            except Parsed:
                break
            except SystemExit:
                status = 2
            refused.append((call[0], status))
        else:
            raise AssertionError(f"{page.name}: no command takes {span}: {refused}")
    capsys.readouterr()


SETTINGS = {
    name: value
    for mapper in SYSTEMS.values()
    for name, value in leaves(to_dict(mapper.config_type())).items()
}
GROUPS = {name.partition(".")[0] for name in SETTINGS if "." in name}
OTHER_NAMES = ("views.json", "views.csv", "tsdf.npz", "window.lr_sh_rest")
"""Files of a run, and a setting of an earlier version."""


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.name)
def test_settings_and_their_values_exist(page):
    groups = "|".join(sorted(GROUPS))
    name_pattern = rf"(?<![\w/.\-])((?:{groups})\.[a-z]\w*(?:\.\w+)*)(?![\w\-])"
    value_pattern = r"(?:\s*=\s*(\S+))?"
    pattern = name_pattern + value_pattern
    for name, value in re.findall(pattern, "\n".join(code(page))):
        if name in OTHER_NAMES:
            continue
        assert name in SETTINGS or any(other.startswith(f"{name}.") for other in SETTINGS), (
            f"{page.name}: {name}"
        )
        parsed = [parse_value(text.strip("\"'`{},")) for text in value.split(",") if value]
        for one in parsed if not str(value).isupper() else []:
            problems = []
            for mapper in SYSTEMS.values():
                with contextlib.suppress(ValueError, AttributeError, TypeError):
                    replace(mapper.config_type(), **{name.replace(".", "__"): one})
                    break
                problems.append(mapper.description.title)
            else:
                raise AssertionError(f"{page.name}: {name} = {one} is refused")


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.name)
def test_python_compiles_and_its_imports_work(page):
    for block in blocks(page, "python"):
        compile(block, page.name, "exec")
        # not a part of this package
        block = re.sub(r"^import (.+)  # pip install .+$", "", block, flags=re.MULTILINE)
        imports: list[ast.stmt] = [
            n for n in ast.walk(ast.parse(block)) if isinstance(n, ast.Import | ast.ImportFrom)
        ]
        exec(
            compile(ast.Module(body=imports, type_ignores=[]), page.name, "exec"),
            {},
        )


MATHEMATICS = blocks(ROOT / "docs/mathematics.md", "python")


@pytest.mark.parametrize("block", MATHEMATICS, ids=["motions", "gaussians", "gradients"])
def test_what_the_mathematics_says_is_so(block):
    assert "assert" in block
    exec(compile(block, "mathematics.md", "exec"), {})
