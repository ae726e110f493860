"""Functions of libraries that were replaced: none is seen where a process has only imported more
than another."""

import json
import multiprocessing.managers
import multiprocessing.pool
import subprocess
import sys

import pytest
import torch

from gsfusion_nb.code_keys.patches import patches

IMPORTS_ALL_OF_PYTHON = """
import contextlib, importlib, io, json, pkgutil, sys, warnings
import gsfusion_nb.compare.program
from gsfusion_nb.code_keys.patches import patches

warnings.simplefilter("ignore")
before = patches()
NOT_TO_IMPORT = {"antigravity", "this", "idlelib", "test", "turtledemo", "__main__"}
names = sorted(set(sys.stdlib_module_names) - NOT_TO_IMPORT)
imported = 0
while names:
    name = names.pop()
    if name.rpartition(".")[2].startswith("_") or name.endswith("__main__"):
        continue
    with contextlib.redirect_stdout(io.StringIO()), contextlib.suppress(BaseException):
        module = importlib.import_module(name)
        imported += 1
        paths = getattr(module, "__path__", ())
        names += [f"{name}.{part.name}" for part in pkgutil.iter_modules(paths)
                  if part.name not in {"test", "tests"}]
after = patches()
print(json.dumps([imported, sorted(name for name in after if after[name] != before.get(name))]))
"""


def test_no_module_of_python_looks_like_a_patch():
    process = subprocess.run(
        [sys.executable, "-c", IMPORTS_ALL_OF_PYTHON], capture_output=True, text=True, timeout=300
    )
    assert process.returncode == 0, process.stderr
    imported, found = json.loads(process.stdout.strip().splitlines()[-1])
    assert imported > 300
    assert found == []


def in_a_namespace_without_a_name():
    names = {}
    exec("def other(self, *args):\n    return 5", names)
    return names["other"]


@pytest.mark.parametrize(
    ("owner", "name"), [(torch.Tensor, "sum"), (multiprocessing.pool.Pool, "map")]
)
def test_a_function_without_a_module_is_a_patch_elsewhere(monkeypatch, owner, name):
    monkeypatch.setattr(owner, name, in_a_namespace_without_a_name())
    assert [found for found in patches() if found.endswith(f".{name}")]


def test_a_function_of_a_notebook_is_a_patch_of_managers_too(monkeypatch):
    namespace = {"__name__": "__main__"}
    exec("def get(self, *args):\n    return 5", namespace)
    monkeypatch.setattr(multiprocessing.managers.DictProxy, "get", namespace["get"])
    assert "multiprocessing.managers.DictProxy.get" in patches()
