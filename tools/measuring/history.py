"""What git knows: whether a commit is here, and which files have other statements since then."""

import ast
import subprocess
from functools import cache
from pathlib import Path

from .recipes import ROOT, MeasuredError


def git(*arguments: str, root: Path = ROOT) -> str:
    """The output of git.

    Raises:
        MeasuredError: git is not there, or failed; an empty answer is never taken for a failure,
            nor the other way.
    """
    try:
        process = subprocess.run(
            ["git", *arguments],
            cwd=root,
            capture_output=True,
            text=True,
        )
    except FileNotFoundError:
        raise MeasuredError(
            "git is not installed, so the age of the tables cannot be known"
        ) from None
    if process.returncode != 0:
        raise MeasuredError(f"git {' '.join(arguments)} failed in {root}: {process.stderr.strip()}")
    return process.stdout


def check_history(root: Path = ROOT) -> None:
    """Check that the whole history is here, by which commits are told from unknown ones.

    Raises:
        MeasuredError: no git checkout, or one whose history was cut.
    """
    process = subprocess.run(
        ["git", "rev-parse", "--show-toplevel"], cwd=root, capture_output=True, text=True
    )
    if process.returncode != 0 or Path(process.stdout.strip()).resolve() != root.resolve():
        raise MeasuredError(
            f"{root} is not a git checkout, so which tables are old cannot be known here"
        )
    if git("rev-parse", "--is-shallow-repository", root=root).strip() == "true":
        raise MeasuredError(
            "the history of this checkout is cut, so the age of the tables cannot be known: run "
            "git fetch --unshallow"
        )


def is_in_history(commit: str, root: Path = ROOT) -> bool:
    """Whether a commit is HEAD or an ancestor of it. One of another branch, or that is gone, is
    not."""
    call = ["git", "merge-base", "--is-ancestor", commit, "HEAD"]
    return subprocess.run(call, cwd=root, capture_output=True).returncode == 0


def changed_files(
    commit: str,
    paths: tuple[str, ...],
    root: Path = ROOT,
) -> list[str]:
    """Files below ``paths`` that are not today what they were at ``commit``. Of a Python file its
    statements count, and neither its layout nor its comments and docstrings."""
    different = git(
        "diff", "--name-only", "--no-renames", f"{commit}..HEAD", "--", *paths, root=root
    ).splitlines()
    return [path for path in different if not is_same_program(commit, path, root)]


@cache
def is_same_program(
    commit: str,
    path: str,
    root: Path = ROOT,
) -> bool:
    """Whether a Python file has the same statements at ``commit`` and today."""
    if not path.endswith(".py"):
        return False
    try:
        then, now = (git("show", f"{side}:{path}", root=root) for side in (commit, "HEAD"))
    except MeasuredError:  # on one side there is no such file
        return False
    return statements(then) == statements(now)


def statements(source: str) -> str:
    """The statements of a Python file as text, without layout, comments and docstrings."""
    tree = ast.parse(source)
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            node.body = [part for part in node.body if not _is_text(part)]
    return ast.dump(tree)


def _is_text(statement: ast.AST) -> bool:
    """Whether a statement is a text that stands by itself, as docstrings do."""
    return (
        isinstance(statement, ast.Expr)
        and isinstance(statement.value, ast.Constant)
        and isinstance(statement.value.value, str)
    )
