"""The house rules that a tool can check: import floors, packaging, no foreign names, light import."""

import ast
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "gsfusion_nb"

FLOORS = {
    **dict.fromkeys(("types", "config", "constants", "checks", "errors", "files", "backends"), 0),
    **dict.fromkeys(("geometry", "drawing"), 1),
    **dict.fromkeys(("tsdf", "gaussians", "render"), 2),
    **dict.fromkeys(("seeding", "optim", "tracking", "export", "evaluation"), 3),
    "mapping": 4,
    "data": 5,
    "runs": 6,
    **dict.fromkeys(("viz", "teaching", "warm"), 7),
    **dict.fromkeys(("doctor", "bench"), 8),
    "studies": 9,
    "cli": 10,
    "__main__": 11,
}

MODULES = sorted(p for p in PACKAGE.rglob("*.py") if p != PACKAGE / "__init__.py")


def imported_rooms(path: Path) -> set[str]:
    """First-level names under gsfusion_nb that the module imports, at any depth of the code."""
    package = list(path.relative_to(PACKAGE).with_suffix("").parts)
    rooms = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        targets: list[list[str]] = []
        if isinstance(node, ast.ImportFrom) and node.level:
            base = package[: len(package) - node.level]
            targets = (
                [[*base, *(node.module or "").split(".")]] if node.module else [[*base, a.name] for a in node.names]
            )
        elif isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "gsfusion_nb":
            rest = (node.module or "").split(".")[1:]
            targets = [rest] if rest else [[a.name] for a in node.names]
        elif isinstance(node, ast.Import):
            targets = [a.name.split(".")[1:] for a in node.names if a.name.split(".")[0] == "gsfusion_nb"]
        rooms |= {t[0] for t in ([part for part in target if part] for target in targets) if t}
    return rooms


@pytest.mark.parametrize("path", MODULES, ids=lambda p: str(p.relative_to(ROOT)))
def test_imports_point_down(path):
    room = path.relative_to(PACKAGE).parts[0].removesuffix(".py")
    assert room in FLOORS, f"{room} has no floor; give it one in design and here"
    for other in imported_rooms(path) & set(FLOORS):
        ground = FLOORS[room] == FLOORS[other] == 0  # the ground floor is one room
        assert other == room or ground or FLOORS[other] < FLOORS[room], (
            f"{path.name} ({room}) imports {other}, which is not below it"
        )


@pytest.mark.parametrize("path", MODULES, ids=lambda p: str(p.relative_to(ROOT)))
def test_only_backends_knows_the_kernels(path):
    if path.name != "backends.py":
        assert "kernels" not in imported_rooms(path)


def test_every_package_is_packaged():
    declared = set(tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]["packages"])
    found = {".".join(p.parent.relative_to(ROOT).parts) for p in PACKAGE.rglob("__init__.py")}
    kernels = (p.parent.relative_to(ROOT).parts for p in (ROOT / "kernels").rglob("__init__.py"))
    found |= {".".join(("gsfusion_nb", *parts)) for parts in kernels}
    assert declared == found


@pytest.mark.parametrize("path", sorted((ROOT / "gsfusion_nb").rglob("*.py")), ids=lambda p: str(p.relative_to(ROOT)))
def test_no_postponed_annotations(path):
    assert "from __future__ import annotations" not in path.read_text(encoding="utf-8")


def test_import_is_light():
    heavy = [
        "cv2",
        "kornia",
        "pyvista",
        "matplotlib",
        "scipy",
        "plyfile",
        "ipywidgets",
        "numba",
        "triton",
        "kernels",
        "tyro",
    ]
    code = f"import sys, gsfusion_nb; print([m for m in {heavy} if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
