"""Groups of kernel arguments, and the numbers of packed rows, are the same in Python and in the CUDA sources."""

import ctypes
import importlib
import re
from pathlib import Path

import pytest

from gsfusion_nb import kernels

FOLDER = Path(kernels.__path__[0])
NAMES = sorted(path.parent.name for path in FOLDER.glob("*/cuda.py"))
C_TYPES = {"int": ctypes.c_int, "float": ctypes.c_float, "double": ctypes.c_double}


def source_of(*paths: Path) -> str:
    """The text without comments."""
    return re.sub(r"//.*", "", "\n".join(path.read_text(encoding="utf-8") for path in paths))


def structs_of(text: str) -> dict[str, list[tuple[str, type]]]:
    """Name and C type of the fields of every struct."""
    found = {}
    for name, body in re.findall(r"struct (?:alignas\(\d+\) )?(\w+) \{(.*?)\};", text, re.DOTALL):
        found[name] = [field for declaration in body.split(";")[:-1] for field in fields_of(declaration)]
    return found


def fields_of(declaration: str) -> list[tuple[str, type]]:
    """Those of a line such as ``const float *D, *W``."""
    (kind, *_) = [*re.sub(r"\b(const|unsigned|signed)\b", "", declaration.split("*")[0]).split(), "int"]
    fields = []
    for part in declaration.split(","):
        name, length = re.findall(r"(\w+)(?:\[(\w+)\])?\s*$", part)[0]
        # "float* a, b" would make only a an address; the sources write "float *a, *b" then
        number = ctypes.c_void_p if "*" in part else C_TYPES.get(kind, ctypes.c_char)
        fields.append((name, number * int(length) if length.isdigit() else number))
    return fields


def groups_of(module) -> list[type]:
    """The named tuples that are declared for CUDA kernels."""
    own = (module.__name__, module.__name__.replace("cuda", "lens"))
    return [kind for kind in vars(module).values() if hasattr(kind, "_fields") and kind.__module__ in own]


@pytest.mark.parametrize("name", NAMES)
def test_groups_are_the_structs_of_the_sources(name):
    structs = importlib.import_module("gsfusion_nb.kernels.runtime.cuda.structs")
    module = importlib.import_module(f"gsfusion_nb.kernels.{name}.cuda")
    declared = structs_of(source_of(*FOLDER.glob(f"{'composite' if name == 'rasterize' else name}/*.cu")))
    groups = groups_of(module)
    assert groups
    for group in groups:
        assert structs.layout(group)._fields_ == declared[group.__name__], group.__name__


def test_a_wrong_group_would_be_found():
    declared = structs_of(source_of(FOLDER / "integrate" / "integrate.cu"))
    assert declared["Band"][0] == ("near", ctypes.c_float)
    assert declared["Band"][-1] == ("ray", ctypes.c_int)
    assert [kind for _, kind in declared["View"][:3]] == [ctypes.c_void_p, ctypes.c_void_p, ctypes.c_double]
    (R, origin, _) = structs_of(source_of(FOLDER / "allocate" / "allocate.cu"))["View"]
    assert ctypes.sizeof(R[1]) == 36
    assert origin != R


def test_rows_have_the_same_columns_everywhere():
    """Splats, the sums of their gradients, and leaves."""
    splat = importlib.import_module("gsfusion_nb.kernels.project.splat")
    sums = importlib.import_module("gsfusion_nb.kernels.composite.sums")
    levels = importlib.import_module("gsfusion_nb.kernels.quadtree.levels")
    header = source_of(FOLDER / "project" / "splat.cuh")
    names = ["u", "v", "A", "B", "C", "ln_o", "r", "g", "b", "z", "e_u", "e_v"]
    assert [name for name, _ in structs_of(header)["Splat"]] == names
    columns = [
        "U",
        "V",
        "CONIC_A",
        "CONIC_B",
        "CONIC_C",
        "LN_OPACITY",
        "RED",
        "GREEN",
        "BLUE",
        "DEPTH",
        "EXTENT_U",
        "EXTENT_V",
    ]
    assert [getattr(splat, column) for column in columns] == [*splat.COLUMNS] == [*range(splat.SPLAT)]
    (enumerators,) = re.findall(r"enum \{ (SUM_\w+, .*?) \};", header)
    *members, count = enumerators.split(", ")
    assert [getattr(sums, member) for member in members] == [*range(sums.PAIR_SUMS)]
    assert (count, len(members)) == ("SUMS", sums.PAIR_SUMS)
    (enumerators,) = re.findall(r"enum \{ (X0, .*?), COLUMNS \};", source_of(FOLDER / "quadtree" / "quadtree.cu"))
    assert [getattr(levels, member) for member in enumerators.split(", ")] == [*levels.LEAF_COLUMNS]
