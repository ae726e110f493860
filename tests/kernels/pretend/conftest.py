"""A GPU that is not there: the mapper's own code on tensors that say they are on one, kernels on the processor.

CUDA kernels run in the emulator, Triton's under the interpreter, both chosen by the environment before Python starts:
``tests/kernels/test_pretend_gpu.py`` does so.
"""

import importlib
import importlib.util
import os
import sys
from pathlib import Path

import pytest
import torch

_RUNS = {"GSFUSION_CUDA_EMULATOR", "TRITON_INTERPRET"} <= set(os.environ) and not torch.version.cuda
collect_ignore_glob = [] if _RUNS and importlib.util.find_spec("triton") else ["test_*.py"]
sys.path.insert(0, str(Path(__file__).parent))


@pytest.fixture
def gpu(monkeypatch):
    """Inside the test there is a GPU, "cuda"; the value counts launches and waits."""
    import tensors  # pyright: ignore[reportMissingImports]

    from gsfusion_nb import kernels
    from gsfusion_nb.kernels.runtime.cuda import driver, launch  # pyright: ignore[reportMissingImports]

    try:
        tensors.lend_a_guard()
    except (RuntimeError, ValueError, OSError) as e:
        pytest.skip(f"no GPU can be pretended with this torch: {e}")
    emulator, emulate = launch._emulator(), launch._emulate
    monkeypatch.setattr(launch, "_emulator", lambda: emulator)
    monkeypatch.setattr(launch, "_EMULATOR", "")

    def start(operation, stem, kernel, grid, block, device, values):
        tensors.tally.launches += 1
        emulate(operation, kernel, grid, block, values)

    def interpret(kernel, programs, device, /, **arguments):
        tensors.tally.launches += 1
        if programs:
            values = {name: a.inner if isinstance(a, tensors.OnGpu) else a for name, a in arguments.items()}
            kernel[(programs,)](**values)

    monkeypatch.setattr(driver, "start", start)
    for path in Path(kernels.__path__[0]).glob("*/triton.py"):
        module = importlib.import_module(f"{kernels.__name__}.{path.parent.name}.triton")
        if hasattr(module, "launch"):
            monkeypatch.setattr(module, "launch", interpret)
    for name, value in (("max_memory_allocated", 0), ("mem_get_info", (1 << 34, 1 << 34))):
        monkeypatch.setattr(torch.cuda, name, lambda *_, value=value: value)
    tensors.tally.clear()
    with torch.no_grad(), tensors.Below(), tensors.Above():
        yield tensors.tally
