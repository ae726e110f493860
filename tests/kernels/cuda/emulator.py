"""Build the kernels as a library for the CPU: the same .cu files, compiled by g++ with
``emulate.h`` in front."""

import re
import subprocess
from pathlib import Path

from gsfusion_nb.render import constants

HERE = Path(__file__).parent
KERNELS = Path(__file__).resolve().parents[3] / "kernels"


def options() -> list[str]:
    """The definitions that ``runtime/cuda/nvrtc.py`` gives to the GPU's compiler, read there
    without importing it."""
    text = (KERNELS / "runtime" / "cuda" / "nvrtc.py").read_text(encoding="utf-8")
    names = re.findall(r'"(\w+)"', re.search(r"_NUMBERS = \((.*?)\)", text, re.DOTALL)[1])  # pyright: ignore[reportOptionalSubscript]
    return [f"-DGS_{name}={getattr(constants, name):.9g}f" for name in names]


def sources() -> list[Path]:
    """The .cu files."""
    return sorted(KERNELS.glob("*/*.cu"))


def includes() -> list[str]:
    """Options that name the folders of the .cuh files."""
    return [f"-I{folder}" for folder in sorted({path.parent for path in KERNELS.glob("*/*.cuh")})]


def kernels_of(source: Path) -> list[str]:
    """Names of the kernels of a .cu file."""
    pattern = r'extern "C" __global__ void (?:__launch_bounds__\([\d, ]+\) )?(\w+)\('
    return re.findall(pattern, source.read_text(encoding="utf-8"))


def sanitizer() -> tuple[dict[str, str], tuple[str, ...]]:
    """Environment and compiler options that end the process at a step outside an array or undefined
    arithmetic."""
    ask = [["g++", f"-print-file-name={name}"] for name in ("libasan.so", "libubsan.so")]
    libraries = [
        subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
        for command in ask
    ]
    options = "detect_leaks=0:detect_stack_use_after_return=0"
    flags = ("-fsanitize=address,undefined", "-fno-sanitize-recover=undefined", "-g")
    return {"LD_PRELOAD": " ".join(libraries), "ASAN_OPTIONS": options}, flags


def build(folder: Path, extra: tuple[str, ...] = ()) -> Path:
    """Compile everything into ``folder``/libemulator.so.

    Raises:
        RuntimeError: it does not compile; g++'s words are in the message.
    """
    units = []
    for source in sources():
        unit = folder / f"{source.stem}.cpp"
        lines = [
            '#include "emulate.h"',
            f"namespace {source.stem}_ {{",
            f'#include "{source}"',
            "}",
        ]
        lines += [f"using {source.stem}_::{name};\nEMULATE({name})" for name in kernels_of(source)]
        unit.write_text("\n".join(lines) + "\n", encoding="utf-8")
        units.append(str(unit))
    library = folder / "libemulator.so"
    flags = [
        "-std=c++20",
        "-O1",
        "-ffp-contract=off",
        "-fPIC",
        "-shared",
        "-Wall",
        "-Wextra",
        "-Werror",
    ]
    flags += [
        "-Wno-unknown-pragmas",
        "-Wno-unused-parameter",
        "-fno-strict-aliasing",
        *extra,
        *options(),
    ]
    command = ["g++", *flags, f"-I{HERE}", *includes(), *units, "-o", str(library)]
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode:
        raise RuntimeError(f"the kernels do not compile for the CPU:\n{done.stderr[-6000:]}")
    return library
