"""The key of a run tells programs apart that compute something else."""

import functools
import math

import pytest
import torch

from gsfusion_nb.compare import program
from gsfusion_nb.seeding import SeedContext
from gsfusion_nb.seeding.points import Neighbours


class Called:
    """Somebody's object in place of a function."""

    def __init__(self, step):
        self.step = step

    def __call__(self, *_, **__):
        return self.step


def of(step):
    return lambda *_, **__: step


CHANGES = {
    "a method of the context": (SeedContext, "corners", of(1), of(2)),
    "another method of the context": (
        SeedContext,
        "corners",
        SeedContext.pixels,
        SeedContext.normals,
    ),
    "an object": (SeedContext, "corners", Called(1), Called(2)),
    "a function in a cache": (torch, "sum", functools.cache(of(1)), functools.cache(of(2))),
    "a new attribute of the context": (SeedContext, "step", 1, 2),
    "defaults of a method": (SeedContext.edges, "__defaults__", (1,), (2,)),
    "attributes of a class": (Neighbours, "step", (1,), (2,)),
    "a number of Python": (math, "pi", 3.0, 3.1),
    "a method of a tensor": (torch.Tensor, "median", torch.Tensor.mean, torch.Tensor.sum),
    "an operator of a tensor": (torch.Tensor, "__mul__", torch.Tensor.__add__, torch.Tensor.mul),
}


@pytest.fixture
def key(monkeypatch):
    """A function that gives the key of the program as it is now; files of libraries are not looked
    at."""
    monkeypatch.setattr(program.installed, "state_of", functools.cache(lambda name: "1.0"))

    def found():
        program.look_at_program_again()
        return program.run_key()

    yield found
    program.look_at_program_again()


@pytest.mark.parametrize(
    ("owner", "name", "first", "second"),
    CHANGES.values(),
    ids=CHANGES,
)
def test_each_change_of_the_program_has_a_key_of_its_own(
    monkeypatch, key, owner, name, first, second
):
    keys = [key()]
    for value in (first, second, second):
        with monkeypatch.context() as patched:
            patched.setattr(owner, name, value, raising=False)
            keys.append(key())
    assert len(set(keys)) == 3
    assert keys[2] == keys[3]
    assert key() == keys[0]


@pytest.mark.parametrize("beginning", program._WATCHED)
def test_each_name_that_is_watched_is_there(beginning):
    names = [f"{namespace.name}." for namespace in program._at_start]
    assert any(name.startswith(beginning) for name in names)


def test_the_kernels_are_code_of_the_package():
    own, *kernels = program._source_folders()
    assert (own / "compare" / "program.py").is_file()
    assert kernels
    assert all((folder / "composite" / "numba.py").is_file() for folder in kernels)


def test_the_source_of_the_package_is_part_of_the_key(monkeypatch, tmp_path):
    """Content and name of each file of code; not copies that JupyterLab makes, nor files of other
    kinds."""
    monkeypatch.setattr(program, "_source_folders", lambda: [tmp_path])
    found = []

    def write(name, text):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text)
        program.package_fingerprint.cache_clear()
        found.append(program.package_fingerprint())

    write("a.py", "X = 1\n")
    for name, text in ((".ipynb_checkpoints/a.py", "X = 2\n"), ("notes.txt", "")):
        write(name, text)
    assert len(set(found)) == 1
    for name, text in (("a.py", "X = 2\n"), ("b.py", ""), ("sub/b.toml", ""), ("sub/b.cu", "")):
        write(name, text)
    assert len(set(found)) == 5
    (tmp_path / "b.py").rename(tmp_path / "c.py")
    write("a.py", "X = 2\n")
    assert len(set(found)) == 6
    program.package_fingerprint.cache_clear()
