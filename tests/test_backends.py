import logging
import sys

import pytest
import torch

from gsfusion_nb import backends
from gsfusion_nb.backends import (
    BackendUnavailable,
    dispatch,
    look_again,
    offers,
    op,
    registry,
    use_backend,
)
from gsfusion_nb.types import GaussianParams


@pytest.fixture
def double(monkeypatch):
    monkeypatch.setattr(registry, "OPERATIONS", dict(registry.OPERATIONS))
    monkeypatch.setattr(registry, "FOLDERS", dict(registry.FOLDERS))
    monkeypatch.setattr(dispatch, "_messages", set())
    monkeypatch.setattr(registry, "KERNELS", "made_kernels")
    look_again()

    @op("double")
    def double(x: torch.Tensor) -> torch.Tensor:
        """Twice."""
        return 2 * x

    yield double
    look_again()


@pytest.fixture
def write_kernel(tmp_path, monkeypatch):
    """``write_kernel(backend, source)``: the file of a backend in the folder of the operation
    ``double``."""
    folder = tmp_path / "made_kernels" / "double"
    folder.mkdir(parents=True)
    for package in (folder, folder.parent):
        (package / "__init__.py").touch()
    monkeypatch.syspath_prepend(tmp_path)

    def write(backend: str, source: str) -> None:
        (folder / f"{backend}.py").write_text(source)
        look_again()

    yield write
    for name in [name for name in sys.modules if name.split(".")[0] == "made_kernels"]:
        del sys.modules[name]


def test_reference_runs_when_there_is_nothing_else(double):
    assert double(torch.ones(2)).tolist() == [2.0, 2.0]
    assert double.__name__ == "double"
    assert double.reference(torch.ones(1)).tolist() == [2.0]


@pytest.mark.usefixtures("double")
@pytest.mark.parametrize("asked", ["auto", "numba"])
def test_gaussians_in_float64_go_to_the_reference_before_a_kernel_sees_them(
    write_kernel, monkeypatch, asked
):
    @op("double")
    def double(params: GaussianParams) -> torch.dtype:
        """The type of the numbers."""
        return params.xyz_W.dtype

    write_kernel("numba", "def double(params):\n    return 'compiled'\n")
    n = {
        "xyz_W": (2, 3),
        "log_scale": (2, 3),
        "quat": (2, 4),
        "opacity_logit": (2,),
        "sh": (2, 1, 3),
    }
    single, twice = (
        GaussianParams(**{name: torch.ones(shape, dtype=dtype) for name, shape in n.items()})
        for dtype in (torch.float32, torch.float64)
    )
    with use_backend(asked):
        assert double(single) == double(params=single) == "compiled"
        assert double(twice) == double(params=twice) == torch.float64


def test_what_a_backend_does_not_offer_runs_on_the_reference(double, write_kernel):
    write_kernel("numba", "def double(x):\n    return x * x\n")
    for backend, expected in (("numba", 9.0), ("triton", 6.0)):
        with use_backend(backend):
            assert double(torch.full((1,), 3.0)).tolist() == [expected]


def test_it_says_once_what_another_backend_would_have(double, write_kernel, caplog):
    write_kernel("numba", "def double(x):\n    return x * x\n")
    with caplog.at_level(logging.INFO, logger="gsfusion_nb.backends"), use_backend("cuda"):
        double(torch.ones(1))
        double(torch.ones(1))
        assert double(torch.ones(1, device="meta")).device.type == "meta"
    with caplog.at_level(logging.INFO, logger="gsfusion_nb.backends"), use_backend("reference"):
        double(torch.ones(1))
    assert [(r.levelname, r.message) for r in caplog.records] == [
        (
            "WARNING",
            "backend 'cuda' has no double, which runs on the slower reference; numba would have it",
        )
    ]


def test_on_an_old_gpu_auto_passes_triton_over_and_says_so(
    double, write_kernel, caplog, monkeypatch
):
    """A T4 has compute capability 7.5. Who asks for Triton by name may try it."""
    write_kernel("triton", "def double(x):\n    return x * x\n")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "get_device_capability", lambda: (7, 5))
    monkeypatch.setattr(dispatch, "_device", lambda args, kwargs: "cuda")
    with caplog.at_level(logging.INFO, logger="gsfusion_nb.backends"):
        assert double(torch.full((1,), 3.0)).tolist() == [6.0]
        with use_backend("triton"):
            assert double(torch.full((1,), 3.0)).tolist() == [9.0]
    assert [(r.levelname, r.message) for r in caplog.records] == [
        (
            "WARNING",
            "double: Triton supports GPUs of compute capability 8.0 and newer, and this one has "
            "7.5; double runs on the slower reference: `gsfusion-nb doctor` says what to install",
        )
    ]
    monkeypatch.setattr(torch.cuda, "get_device_capability", lambda: (8, 0))
    look_again()
    assert double(torch.full((1,), 3.0)).tolist() == [9.0]


@pytest.mark.parametrize("asked", ["numba", "triton", "cuda"])
def test_the_reference_runs_where_nobody_has_kernels(double, asked):
    """Whole maps can be made on any backend: some operations have no kernels."""
    with use_backend(asked):
        assert double(torch.full((1,), 3.0)).tolist() == [6.0]


_NEEDS_A_PACKAGE = (
    "import no_such_package\n\ndef double(x):\n    return no_such_package.double(x)\n"
)


def test_a_missing_package_is_named(double, write_kernel):
    write_kernel("numba", _NEEDS_A_PACKAGE)
    with (
        use_backend("numba"),
        pytest.raises(BackendUnavailable, match="needs 'no_such_package', which is not installed"),
    ):
        double(torch.ones(1))


def test_auto_says_once_that_the_reference_runs_and_what_to_do(double, write_kernel, caplog):
    write_kernel("numba", _NEEDS_A_PACKAGE)
    with caplog.at_level(logging.INFO, logger="gsfusion_nb.backends"):
        assert double(torch.ones(1)).tolist() == [2.0]
        assert double(torch.ones(1)).tolist() == [2.0]
    assert [(r.levelname, r.message) for r in caplog.records] == [
        (
            "WARNING",
            "double: backend 'numba' needs 'no_such_package', which is not installed; double runs "
            "on the slower reference: `gsfusion-nb doctor` says what to install",
        )
    ]


def test_auto_names_the_devices_that_faster_versions_take(double, write_kernel, caplog):
    write_kernel("numba", "def double(x):\n    return x + x\n")
    with caplog.at_level(logging.INFO, logger="gsfusion_nb.backends"):
        assert double(torch.ones(1, device="meta")).device.type == "meta"
    assert [(r.levelname, r.message) for r in caplog.records] == [
        (
            "WARNING",
            "double runs on the slower reference: its faster versions take cpu tensors, and these "
            "are on 'meta'",
        )
    ]


def test_auto_goes_on_to_the_next_backend_that_loads(double, write_kernel, caplog, monkeypatch):
    """Without a warning: numba on the CPU, cuda and triton on a GPU, the reference elsewhere."""
    monkeypatch.setattr(offers, "PREFERRED", {"cpu": ("triton", "numba")})
    write_kernel("triton", _NEEDS_A_PACKAGE)
    write_kernel("numba", "def double(x):\n    return x + x\n")
    with caplog.at_level(logging.INFO, logger="gsfusion_nb.backends"):
        double(torch.ones(1))
    assert [(r.levelname, r.message) for r in caplog.records] == [("INFO", "double: numba")]
    assert [backends.automatic("double", device) for device in ("cpu", "mps")] == [
        "numba",
        "reference",
    ]


def test_without_any_faster_version_the_reference_runs_silently(double, caplog):
    with caplog.at_level(logging.INFO, logger="gsfusion_nb.backends"):
        double(torch.ones(1))
    assert not caplog.records


def test_auto_takes_the_fast_one_and_reference_stays_reachable(double, write_kernel):
    write_kernel("numba", "def double(x):\n    return x * x\n")
    x = torch.tensor([3.0])
    assert double(x).tolist() == [9.0]
    with use_backend("reference"):
        assert double(x).tolist() == [6.0]
    assert ("double", "numba", "ok") in backends.report()


def test_inside_a_reference_every_operation_is_the_reference(double, write_kernel):
    write_kernel("numba", "def double(x):\n    return x * x\n")

    @op("double_twice")
    def double_twice(x: torch.Tensor) -> torch.Tensor:
        """Four times."""
        return double(double(x))

    x = torch.tensor([3.0])
    assert double_twice(x).tolist() == [81.0]
    assert double_twice.reference(x).tolist() == [12.0]


def test_a_record_is_differentiated_by_the_backend_that_made_it(double, write_kernel):
    @op("double")
    def double_vjp(record: backends.Record) -> str:
        """Where it ran."""
        return "reference"

    class Made(backends.Record):
        backend = "numba"

    write_kernel("numba", "def double_vjp(record):\n    return 'numba'\n")
    for backend in ("auto", "reference", "numba"):
        with use_backend(backend):
            assert double_vjp(Made()) == "numba"
            assert double_vjp(backends.Record()) == "reference"


def test_unknown_backend_lists_the_known():
    with (
        pytest.raises(
            KeyError, match="no backend 'nubma'; known: auto, cuda, mine, numba, reference, triton"
        ),
        use_backend("nubma"),
    ):
        pass
