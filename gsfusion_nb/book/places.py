"""Where a file of the project is in the book: a page, or a page with its source."""

import ast
import functools
import os
import re
import subprocess
from dataclasses import dataclass, field
from pathlib import Path

_SHOWN = {".py", ".js", ".css", ".html", ".toml", ".cu", ".cuh", ".h", ".vert", ".frag", ".mjs", ".md", ".yml", ""}
_PAGES = re.compile(
    r"(README|ARCHITECTURE|CONTRIBUTING)\.md|docs/(measured/|teaching/(quiz/)?)?[^/]+\.md|notebooks/[^/]+\.ipynb"
)


@dataclass(frozen=True, kw_only=True, eq=False)
class Places:
    """The project's files, and where each of them is in the book.

    Args:
        root: The project.
        files: Paths of its files, below ``root``.
    """

    root: Path
    files: frozenset[str]
    asked: set[str] = field(default_factory=set)
    """Files that a page has a link to the source of."""

    def is_page(self, path: str) -> bool:
        """Whether a file is a page of the book; a notebook is."""
        return bool(_PAGES.fullmatch(path)) and path in self.files

    def is_shown(self, path: str) -> bool:
        """Whether a file has a page with its source."""
        return path in self.files and Path(path).suffix in _SHOWN and not path.startswith("tests/course/submissions")

    def source_url(self, path: str, *, seen_from: str, line: int = 0) -> str:
        """Address of the source page of a file, relative to the page ``seen_from``."""
        self.asked.add(path)
        up = os.path.relpath(f"source/{path}.html", Path(seen_from).parent.as_posix() or ".")
        return Path(up).as_posix() + (f"#L-{line}" if line else "")

    def line_of(self, path: str, name: str) -> int:
        """Number of the line in which ``name`` (``function``, ``Class`` or ``Class.method``) is defined; 0 if none."""
        return _definitions(self.root / path).get(name, 0)

    def line_with(self, path: str, piece: str) -> int:
        """Number of the only line that contains a text; 0 if there is none, or more than one."""
        lines = (self.root / path).read_text(encoding="utf-8").splitlines()
        found = [number for number, line in enumerate(lines, 1) if piece in line]
        return found[0] if len(found) == 1 else 0


@functools.cache
def _definitions(path: Path) -> dict[str, int]:
    if path.suffix != ".py":
        return {}
    found: dict[str, int] = {}

    def note(nodes: list[ast.stmt], prefix: str) -> None:
        for node in nodes:
            if isinstance(node, ast.FunctionDef | ast.ClassDef):
                found.setdefault(prefix + node.name, node.lineno)
                if isinstance(node, ast.ClassDef):
                    note(node.body, f"{prefix}{node.name}.")

    note(ast.parse(path.read_text(encoding="utf-8")).body, "")
    return {**{name.rpartition(".")[2]: line for name, line in found.items()}, **found}


def places_of(root: Path) -> Places:
    """The files that git knows in a project; without git, those in its folders."""
    try:
        listed = subprocess.run(["git", "-C", str(root), "ls-files"], capture_output=True, text=True, check=True)
        files = listed.stdout.splitlines()
    except (OSError, subprocess.CalledProcessError):
        files = []
    if not files:
        tops = ("gsfusion_nb", "kernels", "docs", "notebooks", "tests", "data_scripts")
        found = [p for top in tops for p in (root / top).rglob("*")] + [*root.glob("*.md"), root / "pyproject.toml"]
        files = [p.relative_to(root).as_posix() for p in found if p.is_file() and "__pycache__" not in p.parts]
    return Places(root=root, files=frozenset(f for f in files if (root / f).is_file()))
