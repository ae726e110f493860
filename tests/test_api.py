"""The API page is true: its tables are made from docstrings, its names exist, its examples run, types are shipped.

``python tests/test_api.py`` writes the tables again.
"""

import ast
import importlib
import inspect
import json
import re
import tomllib
from collections.abc import Iterator
from pathlib import Path

import torch

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs/api.md"
TABLES = re.compile(r"(<!-- stable -->\n).*?(## May change\n.*?<!-- may change -->\n).*?(<!-- end -->\n)", re.DOTALL)

STABLE = {
    "gsfusion_nb": "run_mapping map_stream open_sequence gsfusion rtg_slam gps_slam GSFusion RTGSLAM GPSSLAM "
    "seeding_rule use_backend",
    "gsfusion_nb.types": "Camera Frame GaussianParams Mesh RenderOutput Seeds",
    "gsfusion_nb.config": "from_dict replace to_dict",
    "gsfusion_nb.runs": "resume_mapping rescore",
    "gsfusion_nb.mapping": "Mapper StepReport make_mapper LossFunction",
    "gsfusion_nb.seeding": "Cells MapRule SeedContext check_rule quadtree registered",
    "gsfusion_nb.gaussians": "GaussianModel Edit",
    "gsfusion_nb.render": "render render_forward render_vjp render_autograd pose_vjp pose_matrix_vjp",
    "gsfusion_nb.optim": "TrainingView UpdateFunction ViewLoss adam_update dssim dssim_vjp fit_pose l1 l1_vjp",
    "gsfusion_nb.tsdf": "TsdfVolume extract_mesh fuse_frame_ raycast",
    "gsfusion_nb.evaluation": "ate_rmse centres_to_own_mesh disc_scores lpips lpips_as_released mesh_scores psnr rpe "
    "score_views ssim ssim_as_released",
    "gsfusion_nb.export": "read_gaussians write_gaussian_ply write_mesh_ply write_trajectory_tum",
    "gsfusion_nb.geometry": "backproject project quaternion rays se3",
    "gsfusion_nb.files": "BadFrameError SequenceError",
}
"""Module -> names that stay, or change with a line in CHANGELOG.md and an error that says what to use instead."""

WITHOUT_DOCSTRING = {
    "LossFunction": "The type of a loss that is given to a mapper: `loss(rendered, view) -> ViewLoss`.",
    "UpdateFunction": "The type of an optimiser: `update(param, gradient, m, v, steps, *, lr)`, in place.",
}


def names_of_notebooks() -> dict[str, set[str]]:
    """Module -> names that the chapters import from it; a module that is imported as a whole counts as a name."""
    found: dict[str, set[str]] = {}
    for path in (ROOT / "notebooks").glob("*.ipynb"):
        for cell in json.loads(path.read_text(encoding="utf-8"))["cells"]:
            lines = "".join(cell["source"]).splitlines() if cell["cell_type"] == "code" else []
            code = "\n".join("pass" if line.startswith(("%", "!")) else line for line in lines)
            for node in ast.walk(ast.parse(code)):
                if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "gsfusion_nb":
                    found.setdefault(node.module or "", set()).update(alias.name for alias in node.names)
                for alias in node.names if isinstance(node, ast.Import) else ():
                    if alias.name.startswith("gsfusion_nb."):
                        module, _, name = alias.name.rpartition(".")
                        found.setdefault(module, set()).add(name)
    return found


def names_that_may_change() -> dict[str, set[str]]:
    """What chapters import and is not stable: a name that is stable elsewhere is stable here, too."""
    stable = {id(get(module, name)) for module, names in STABLE.items() for name in names.split()}
    rest = {m: {n for n in names if id(get(m, n)) not in stable} for m, names in names_of_notebooks().items()}
    return {module: names for module, names in sorted(rest.items()) if names}


def get(module: str, name: str) -> object:
    """The object of this name, or the module."""
    value = getattr(importlib.import_module(module), name, None)
    return importlib.import_module(f"{module}.{name}") if value is None else value


def meaning(module: str, name: str) -> str:
    """The first sentence of the docstring, on one line, as a cell of a table."""
    text = WITHOUT_DOCSTRING.get(name) or inspect.getdoc(get(module, name)) or ""
    assert text, f"{module}.{name} has no docstring"
    first = re.split(r"(?<=\.)\s", " ".join(text.split("\n\n")[0].split()))[0]
    return first.replace("``", "`").replace("|", "\\|")


def table(modules: dict[str, set[str]]) -> Iterator[str]:
    for module, names in modules.items():
        yield f"\n`{module}`\n\n| name | what it is |\n|---|---|\n"
        for name in sorted(names, key=lambda name: (name.lower(), name)):
            yield f"| `{name}` | {meaning(module, name)} |\n"
    yield "\n"


def renewed(page: str) -> str:
    """The page with its tables made again."""
    stable = "".join(table({module: set(names.split()) for module, names in STABLE.items()}))
    rest = "\n| module | names |\n|---|---|\n"
    for module, names in names_that_may_change().items():
        in_order = sorted(names, key=lambda name: (name.lower(), name))
        rest += f"| `{module}` | {', '.join(f'`{name}`' for name in in_order)} |\n"
    rest += "\n"
    return TABLES.sub(lambda m: m[1] + stable + m[2] + rest + m[3], page)


def test_the_tables_are_those_of_the_docstrings():
    page = PAGE.read_text(encoding="utf-8")
    assert renewed(page) == page, "python tests/test_api.py writes the tables of docs/api.md again"


def test_every_name_of_the_page_imports_and_every_name_of_a_notebook_is_on_it():
    page = PAGE.read_text(encoding="utf-8")
    of_page: set[int] = set()
    module = ""
    for line in page[page.index("<!-- stable -->") :].splitlines():
        if heading := re.fullmatch(r"`(gsfusion_nb[\w.]*)`", line):
            module = heading[1]
        elif row := re.match(r"\| `(gsfusion_nb[\w.]*)` \| (.*) \|", line):
            of_page |= {id(get(row[1], name)) for name in re.findall(r"`(\w+)`", row[2])}
        elif row := re.match(r"\| `(\w+)` \|", line):
            of_page.add(id(get(module, row[1])))
    assert len(of_page) > 150
    missing = [f"{m}.{n}" for m, names in names_of_notebooks().items() for n in names if id(get(m, n)) not in of_page]
    assert missing == []


def test_the_examples_run():
    """The camera finds its pose again, to a tenth of the distance; the mappers say that they are not the default."""
    blocks = re.findall(r"^```python\n(.*?)^```", PAGE.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)
    known: dict = {}
    for block in blocks:
        exec(compile(block, str(PAGE), "exec"), known)
    true, start, found = known["frame"].T_WC, known["T_start"], known["T_found"]
    assert (found - true).norm() < 0.25 * (start - true).norm()
    assert known["mapper"].training.names == {"loss": "charbonnier", "optimiser": "sgd"}
    assert len(known["mapper"].gaussians) > 100
    assert bool(torch.stack([c.isfinite().all() for c in vars(known["mapper"].gaussians.params).values()]).all())


def test_the_gradient_of_the_examples_loss_is_that_of_its_value():
    known: dict = {"torch": torch}
    block = next(
        b for b in re.findall(r"^```python\n(.*?)^```", PAGE.read_text(), re.M | re.S) if "def charbonnier" in b
    )
    functions: list[ast.stmt] = [
        n for n in ast.parse(block).body if isinstance(n, ast.ImportFrom | ast.Import | ast.FunctionDef)
    ]
    exec(compile(ast.Module(body=functions, type_ignores=[]), str(PAGE), "exec"), known)

    class Rendered:
        rgb = torch.rand(4, 5, 3, dtype=torch.float64, requires_grad=True)

    class View:
        rgb = torch.rand(4, 5, 3, dtype=torch.float64)
        pixels = torch.arange(20).reshape(4, 5) % 3 > 0

    loss = known["charbonnier"](Rendered, View)
    torch.testing.assert_close(loss.v_rgb.detach(), torch.autograd.grad(loss.value, Rendered.rgb)[0])


def test_type_checkers_find_the_types():
    assert (ROOT / "gsfusion_nb/py.typed").is_file()
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]
    assert "py.typed" in settings["package-data"]["gsfusion_nb"]


if __name__ == "__main__":
    PAGE.write_text(renewed(PAGE.read_text(encoding="utf-8")), encoding="utf-8")
