"""The house rules that a tool can check: import floors, packaging, no foreign names, light
import."""

import ast
import functools
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "gsfusion_nb"

FLOORS = {
    **dict.fromkeys(("types", "arrays", "config", "checks", "errors", "files", "interrupts"), 0),
    **dict.fromkeys(("progress", "resources", "edit_count", "backends", "extensions"), 0),
    **dict.fromkeys(("compile_clock",), 0),
    **dict.fromkeys(("geometry", "drawing", "code_keys"), 1),
    **dict.fromkeys(("data", "tsdf", "gaussians", "render"), 2),
    "large_maps": 3,
    **dict.fromkeys(("seeding", "optim", "tracking", "export", "evaluation"), 4),
    **dict.fromkeys(("mapping", "viewer"), 5),
    **dict.fromkeys(("recordings", "runs"), 6),
    **dict.fromkeys(("viz", "course"), 7),
    "compare": 8,
    "cli": 9,
    "__main__": 10,
}

MOST_METHODS = 20
"""Of a class, properties included; what is more has a second job, or is a function."""

MODULES = sorted(p for p in PACKAGE.rglob("*.py") if p != PACKAGE / "__init__.py")


@functools.cache
def imports_of(path: Path) -> list[ast.Import | ast.ImportFrom]:
    """The imports in a file, at any depth of its code."""
    nodes = ast.walk(ast.parse(path.read_text(encoding="utf-8")))
    return [node for node in nodes if isinstance(node, ast.Import | ast.ImportFrom)]


@functools.cache
def imported_rooms(path: Path) -> set[str]:
    """First-level names under gsfusion_nb that the module imports, at any depth of the code."""
    package = list(path.relative_to(PACKAGE).with_suffix("").parts)
    rooms = set()
    for node in imports_of(path):
        targets: list[list[str]] = []
        if isinstance(node, ast.ImportFrom) and node.level:
            base = package[: len(package) - node.level]
            targets = (
                [[*base, *(node.module or "").split(".")]]
                if node.module
                else [[*base, a.name] for a in node.names]
            )
        elif (
            isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "gsfusion_nb"
        ):
            rest = (node.module or "").split(".")[1:]
            targets = [rest] if rest else [[a.name] for a in node.names]
        elif isinstance(node, ast.Import):
            targets = [
                a.name.split(".")[1:] for a in node.names if a.name.split(".")[0] == "gsfusion_nb"
            ]
        rooms |= {t[0] for t in ([part for part in target if part] for target in targets) if t}
    return rooms


def upward_imports(path: Path) -> list[str]:
    """A sentence for each room that the module imports and that is not below its own."""
    room = path.relative_to(PACKAGE).parts[0].removesuffix(".py")
    if room not in FLOORS:
        return [
            f"{path.relative_to(ROOT)}: {room} has no floor; give it one in ARCHITECTURE.md and "
            "here"
        ]
    return [
        f"{path.relative_to(ROOT)} ({room}) imports {other}, which is not below it"
        for other in sorted(imported_rooms(path) & set(FLOORS))
        if other != room and not FLOORS[room] == FLOORS[other] == 0  # the ground floor is one room
        if FLOORS[other] >= FLOORS[room]
    ]


def test_imports_point_down():
    assert len(MODULES) > 200
    assert [sentence for path in MODULES for sentence in upward_imports(path)] == []


def test_the_check_of_a_recording_is_below_nothing_that_maps():
    """Opening and mapping a recording need no checker: what they share lies in ``data/adjust``."""
    who = [p for p in MODULES if p.parts[-2] in ("adjust", "runs")]
    found = [
        p for p in who for node in imports_of(p) if "checkup" in (getattr(node, "module", "") or "")
    ]
    assert len(who) > 10
    assert found == []


def test_an_import_that_points_up_is_found(monkeypatch):
    monkeypatch.setitem(FLOORS, "runs", 2)
    path = PACKAGE / "runs" / "map_sequence.py"
    assert (
        f"{path.relative_to(ROOT)} (runs) imports mapping, which is not below it"
        in upward_imports(path)
    )


def test_only_backends_knows_the_kernels():
    knowing = [
        str(p.relative_to(ROOT))
        for p in MODULES
        if "kernels" in imported_rooms(p) and p.parent.name != "backends"
    ]
    assert knowing == []


class ImportGraph:
    """Which file imports which, at any depth of the code. A name that a package passes on counts as
    imported from the file that defines it."""

    def __init__(self, roots: dict[str, Path]):
        self.files = {
            self._dotted(path, package, root): path
            for package, root in roots.items()
            for path in root.rglob("*.py")
        }
        self.names = {module: list(self._imported_names(module)) for module in self.files}
        self.edges = {module: self._edges(module) for module in self.files}

    @staticmethod
    def _dotted(path: Path, package: str, root: Path) -> str:
        parts = [package, *path.relative_to(root).with_suffix("").parts]
        return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)

    def _imported_names(self, module: str):
        """(module, name in it or "", name here) of every import from the graph's packages."""
        parts = (
            module.split(".")
            if self.files[module].name == "__init__.py"
            else module.split(".")[:-1]
        )
        for node in imports_of(self.files[module]):
            if isinstance(node, ast.ImportFrom):
                base = parts[: len(parts) - node.level + 1] if node.level else []
                source = ".".join([*base, *([node.module] if node.module else [])])
                yield from ((source, a.name, a.asname or a.name) for a in node.names)
            else:
                yield from ((a.name, "", a.asname or a.name) for a in node.names)

    def defining(self, module: str, name: str) -> str:
        """The file that ``name`` of ``module`` comes from."""
        if f"{module}.{name}" in self.files:
            return f"{module}.{name}"
        for source, theirs, here in self.names.get(module, []):
            if here == name and (source, theirs) != (module, name) and source in self.files:
                return self.defining(source, theirs)
        return module

    def _edges(self, module: str) -> set[str]:
        found = {
            self.defining(source, name) if name else source
            for source, name, _ in self.names[module]
        }
        return {other for other in found if other in self.files and other != module}

    def circles(self) -> list[frozenset[str]]:
        """Groups of files each of which leads back to itself: strongly connected components of two
        or more."""
        reach = {module: self._reached(module) for module in self.files}
        return sorted(
            {frozenset(b for b in reach[a] if a in reach[b]) for a in self.files if a in reach[a]},
            key=sorted,
        )

    def _reached(self, module: str) -> set[str]:
        seen = set()
        waiting = [*self.edges[module]]
        while waiting:
            if (other := waiting.pop()) not in seen:
                seen.add(other)
                waiting += self.edges[other]
        return seen


@functools.cache
def package_graph() -> ImportGraph:
    """Imports in the whole package."""
    return ImportGraph({"gsfusion_nb": PACKAGE, "gsfusion_nb.kernels": ROOT / "kernels"})


def test_no_files_import_each_other():
    graph = package_graph()
    assert len(graph.files) > 200
    assert [sorted(circle) for circle in graph.circles()] == []


def test_files_of_a_package_import_the_file_that_defines_a_name():
    graph = package_graph()
    detours = [
        f"{module} imports {name} from {source}; it is defined in {graph.defining(source, name)}"
        for module, names in graph.names.items()
        for source, name, _ in names
        if module.startswith(f"{source}.")
        and name
        and graph.defining(source, name) not in (source, f"{source}.{name}")
    ]
    assert detours == []


def test_a_circle_through_a_package_is_found(tmp_path):
    files = {"__init__.py": "from .a import A as A\n", "a.py": "from .b import B\n", "c.py": ""}
    files |= {"b.py": "def late():\n    from pkg import A, c\n"}
    for name, text in files.items():
        (tmp_path / name).write_text(text)
    assert ImportGraph({"pkg": tmp_path}).circles() == [{"pkg.a", "pkg.b"}]


def large_classes(path: Path) -> list[str]:
    """The classes in a file with more than ``MOST_METHODS``, with their number of methods."""
    classes = [
        node
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.ClassDef)
    ]
    sizes = {
        node.name: len([part for part in node.body if isinstance(part, ast.FunctionDef)])
        for node in classes
    }
    return [f"{path.name}: {name} has {n}" for name, n in sizes.items() if n > MOST_METHODS]


def test_a_class_has_one_job():
    files = [p for room in ("gsfusion_nb", "kernels", "tools") for p in (ROOT / room).rglob("*.py")]
    assert len(files) > 300
    assert [sentence for path in files for sentence in large_classes(path)] == []


def test_a_class_with_too_many_methods_is_found(tmp_path):
    path = tmp_path / "large.py"
    methods = [f"    def f{i}(self): ...\n" for i in range(MOST_METHODS)]
    small = "class Small:\n    def __len__(self): ...\n"
    path.write_text("".join(["class Large:\n", *methods, "    def __len__(self): ...\n", small]))
    assert large_classes(path) == [f"large.py: Large has {MOST_METHODS + 1}"]


def test_no_postponed_annotations():
    postponed = "from __future__ import annotations"
    having = [
        str(p.relative_to(ROOT))
        for p in PACKAGE.rglob("*.py")
        if postponed in p.read_text(encoding="utf-8")
    ]
    assert having == []


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
    done = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout.strip() == "[]"
