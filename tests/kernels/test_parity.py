"""Every backend against the reference, on every case of ``tests/plugins/kernel_cases``.

A new operation, or a new backend of one, is tested here as soon as its file exists.
"""

import functools
import os
import sys
from typing import Any

import pytest
import torch
from kernel_cases import Case, all_cases

from gsfusion_nb import backends
from gsfusion_nb.backends import BackendUnavailable, registry, use_backend
from gsfusion_nb.backends.offers import EMULATED_BY

EMULATES = [b for b, variable in EMULATED_BY.items() if os.environ.get(variable)]
"""Backends for GPUs that this session of pytest runs on the processor; it is started for them
alone."""

GPU_BACKENDS = ("triton", "cuda") if torch.cuda.is_available() and not EMULATES else ()

FLOAT64_TOLERANCE = 1e-9
"""Of the largest value: sums may be taken in another order, and that is all."""


@functools.cache
def reference_of(case, dtype: torch.dtype) -> dict[str, torch.Tensor]:
    with use_backend("reference"):
        return case.run(torch.device("cpu"), dtype)


def runs(cases) -> list:
    """(case, backend, dtype) for every backend that offers the case's operations."""
    return [
        pytest.param(
            case,
            backend,
            dtype,
            id=f"{backend}-{'+'.join(case.operations)}-{case.name}-{str(dtype)[6:]}",
        )
        for case in cases
        for backend in backends.BACKENDS[1:]
        if any(backend in backends.offered(operation) for operation in case.operations)
        if not EMULATES or backend in EMULATES
        for dtype in case.dtypes
    ]


def check(case, backend: str, dtype: torch.dtype, compare_on) -> None:
    """Run the case on the backend and on the reference and hold the results together."""
    for operation in case.operations:
        if backend in backends.offered(operation):
            backends.load(operation, backend)
    device = torch.device("cuda" if backend in GPU_BACKENDS else "cpu")
    with use_backend(backend):
        found = case.run(device, dtype)
    expected = reference_of(case, dtype)
    assert list(found) == list(expected)
    tolerance = case.tolerance if dtype == torch.float32 else FLOAT64_TOLERANCE
    for name, value in found.items():
        compare_on(
            backend,
            "+".join(case.operations),
            name,
            value,
            expected[name],
            tolerance,
            case.flips,
        )


@pytest.mark.parametrize(("case", "backend", "dtype"), runs(all_cases()))
def test_same_as_the_reference(case, backend, dtype, compare_on):
    try:
        check(case, backend, dtype, compare_on)
    except BackendUnavailable as e:
        if "has no implementation" in str(e):
            raise
        pytest.skip(str(e))


ONE_OF_EACH = {
    case.operations: case for case in all_cases() if "numba" in backends.offered(case.operations[0])
}
"""The last case of every set of operations."""


@pytest.mark.parametrize(
    "case",
    ONE_OF_EACH.values(),
    ids=lambda case: "+".join(case.operations),
)
def test_threads_do_not_change_a_bit(case):
    results = []
    for threads in (1, 2):
        torch.set_num_threads(threads)
        with use_backend("numba"):
            results.append(case.run(torch.device("cpu"), torch.float32))
    torch.set_num_threads(1)
    for name, value in results[0].items():
        assert torch.equal(value, results[1][name]), name


def test_every_offered_operation_has_a_case():
    covered = {operation for case in all_cases() for operation in case.operations}
    assert not set(backends.operations()) - covered


@pytest.fixture
def made_kernels(tmp_path, monkeypatch):
    """A package of kernels with one folder, ``halve``, whose operation is declared; the folder to
    write into."""
    monkeypatch.setattr(registry, "OPERATIONS", dict(registry.OPERATIONS))
    monkeypatch.setattr(registry, "FOLDERS", dict(registry.FOLDERS))
    monkeypatch.setattr(registry, "KERNELS", "made_kernels")
    monkeypatch.syspath_prepend(tmp_path)
    folder = tmp_path / "made_kernels" / "halve"
    folder.mkdir(parents=True)
    for package in (folder, folder.parent):
        (package / "__init__.py").touch()

    @backends.op("halve")
    def halve(x: torch.Tensor) -> torch.Tensor:
        """x / 2"""
        return x / 2

    monkeypatch.setattr(torch, "halve_of_the_test", halve, raising=False)
    backends.look_again()
    yield folder
    for name in [name for name in sys.modules if name.split(".")[0] == "made_kernels"]:
        del sys.modules[name]
    backends.look_again()


def run_halve(
    device: torch.device,
    dtype: torch.dtype,
) -> dict[str, torch.Tensor]:
    made: Any = torch
    return {"half": made.halve_of_the_test(torch.arange(5, device=device, dtype=dtype))}


def test_a_new_backend_is_one_file(made_kernels, compare_on):
    """Written into a folder: parity finds it."""
    (made_kernels / "numba.py").write_text("def halve(x):\n    return 0.5 * x\n")
    backends.look_again()
    found = [
        param.values
        for param in runs([Case(name="counting", operations=("halve",), run=run_halve)])
    ]
    assert [(case.name, backend) for case, backend, _ in found] == [("counting", "numba")] * 2
    for case, backend, dtype in found:
        check(case, backend, dtype, compare_on)
    (made_kernels / "numba.py").write_text("def halve(x):\n    return 0.51 * x\n")
    del sys.modules["made_kernels.halve.numba"]
    backends.look_again()
    with pytest.raises(AssertionError, match="halve half: 4 of 5 differ"):
        check(found[0][0], "numba", torch.float32, compare_on)
