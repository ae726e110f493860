"""Groups of kernel arguments, and the numbers of packed rows, are the same in Python and in the CUDA sources."""

import ctypes
import importlib
import re
from pathlib import Path

import pytest
import torch

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
    declared = structs_of(source_of(*FOLDER.glob(f"{'composite' if name == 'rasterize' else name}/*.cu*")))
    shared = [kind for kind in vars(module).values() if hasattr(kind, "_fields") and kind.__name__ in declared]
    for group in dict.fromkeys([*groups_of(module), *shared]):
        assert structs.layout(group)._fields_ == declared[group.__name__], group.__name__


def test_most_kernels_have_groups():
    modules = [importlib.import_module(f"gsfusion_nb.kernels.{name}.cuda") for name in NAMES]
    assert sum(bool(groups_of(module)) for module in modules) >= len(NAMES) - 1


def test_arguments_lie_where_a_compiler_puts_them():
    """Against ctypes: groups, arrays and numbers of 64 bits after those of 32."""
    structs = importlib.import_module("gsfusion_nb.kernels.runtime.cuda.structs")
    allocate = importlib.import_module("gsfusion_nb.kernels.allocate.cuda")
    tensor = torch.zeros(4)
    view = allocate.View(R=[1.0 + i for i in range(9)], origin=[0.5, 0.25, 0.125], base=[-1, -2, -3])
    args = [True, tensor, view, 7, ctypes.c_double(0.1), None, -0.75, ctypes.c_longlong(-(2**40))]
    pointers, kept = pack(structs, args)
    kinds = [ctypes.c_int, ctypes.c_void_p, structs.layout(allocate.View), ctypes.c_int, ctypes.c_double]
    kinds += [ctypes.c_void_p, ctypes.c_float, ctypes.c_longlong]
    assert all(p % ctypes.alignment(kind) == 0 for p, kind in zip(offsets(pointers), kinds, strict=True))
    found = [kind.from_address(p) for p, kind in zip(pointers, kinds, strict=True)]
    assert list(found[2].R) == view.R
    assert (list(found[2].origin), list(found[2].base)) == (view.origin, view.base)
    numbers = [value.value for i, value in enumerate(found) if i != 2]
    assert numbers == [1, tensor.data_ptr(), 7, 0.1, None, -0.75, -(2**40)]
    assert len(kept) >= ctypes.sizeof(structs.layout(allocate.View)) + 44


def pack(structs, args):
    layout = structs.Arguments(args)
    return layout.pack("op", layout.flat(args))


def offsets(pointers):
    return [p - pointers[0] for p in pointers]


def test_arguments_that_do_not_fit_are_refused():
    structs = importlib.import_module("gsfusion_nb.kernels.runtime.cuda.structs")
    for wrong in (2**31, 1e39):
        with pytest.raises(ValueError, match="op: a number does not fit in the kernel's 32 bits"):
            pack(structs, [wrong])
    with pytest.raises(ValueError, match="op: tensors without gaps were expected"):
        structs.Arguments([torch.zeros(2)]).pack("op", [torch.zeros(2, 2)[:, 0]])


def test_a_wrong_group_would_be_found():
    declared = structs_of(source_of(FOLDER / "integrate" / "voxel.cuh"))
    assert declared["Band"][0] == ("far", ctypes.c_float)
    assert declared["Band"][-1] == ("by_distance", ctypes.c_int)
    assert [kind for _, kind in declared["View"][:2]] == [ctypes.c_void_p, ctypes.c_double]
    (R, origin, _) = structs_of(source_of(FOLDER / "allocate" / "allocate.cu"))["View"]
    assert ctypes.sizeof(R[1]) == 36
    assert origin != R


def test_rows_have_the_same_columns_everywhere():
    """Splats, the sums of their gradients, and leaves."""
    splat = importlib.import_module("gsfusion_nb.kernels.project.layout")
    sums = importlib.import_module("gsfusion_nb.kernels.composite.layout")
    levels = importlib.import_module("gsfusion_nb.kernels.quadtree.torch")
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
