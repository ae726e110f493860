"""Compile the kernel launches given on standard input, without a GPU, and print what each takes:
run as a script.

Input: JSON,
``[{"module", "kernel", "types": {argument: type}, "constants": {name: value}, "num_warps"}, ...]``.
Arguments: compute capabilities, 90 for sm_90. Output: one line per kernel, then "compiled N".
"""

# A script says what it found:
# ruff: noqa: T201

import importlib
import json
import subprocess
import sys
import tempfile
from pathlib import Path

import torch
import triton
from triton.backends.compiler import GPUTarget
from triton.compiler import ASTSource
from triton.compiler.compiler import make_backend

torch.cuda.is_available = lambda: True  # the package asks before it is imported


def source(launch: dict, target: GPUTarget) -> ASTSource:
    kernel = getattr(importlib.import_module(launch["module"]), launch["kernel"])
    types = launch["types"]
    constants = launch["constants"]
    backend = make_backend(target)
    if not hasattr(backend, "parse_attr"):  # triton 3.2
        return ASTSource(kernel, types, constants)
    aligned = backend.parse_attr("D")
    attrs = {
        (kernel.arg_names.index(name),): aligned
        for name, kind in types.items()
        if kind.startswith("*")
    }
    signature = {name: types.get(name, "constexpr") for name in kernel.arg_names}
    return ASTSource(fn=kernel, signature=signature, constexprs=constants, attrs=attrs)


def resources(cubin: bytes) -> str:
    """Registers, stack and shared memory, as the CUDA tools print them."""
    tool = Path(triton.__file__).parent / "backends/nvidia/bin/cuobjdump"
    with tempfile.NamedTemporaryFile(suffix=".cubin") as file:
        file.write(cubin)
        file.flush()
        done = subprocess.run([tool, "-res-usage", file.name], capture_output=True, text=True)
    lines = [line.strip() for line in done.stdout.splitlines() if "REG:" in line]
    return " ".join(lines[0].split()[:4]) if lines else ""


def main() -> None:
    launches = json.load(sys.stdin)
    for capability in map(int, sys.argv[1:]):
        target = GPUTarget("cuda", capability, 32)
        for launch in launches:
            options = {"num_warps": launch["num_warps"]}
            done = triton.compile(source(launch, target), target=target, options=options)
            flags = " ".join(f"{k}={v}" for k, v in launch["constants"].items())
            print(
                f"sm_{capability} {launch['kernel']} [{flags}] {resources(done.asm['cubin'])}",
                flush=True,
            )
    print(f"compiled {len(launches)}")


main()
