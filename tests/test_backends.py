import logging

import pytest
import torch

from gsfusion_nb import backends
from gsfusion_nb.backends import BackendUnavailable, load, op, use_backend


@pytest.fixture
def double(monkeypatch):
    monkeypatch.setattr(backends, "_OPS", dict(backends._OPS))
    monkeypatch.setattr(backends, "PROVIDERS", dict(backends.PROVIDERS))
    monkeypatch.setattr(backends, "_logged", set())
    load.cache_clear()

    @op
    def double(x: torch.Tensor) -> torch.Tensor:
        """Twice."""
        return 2 * x

    yield double
    load.cache_clear()


def test_reference_runs_when_there_is_nothing_else(double):
    assert double(torch.ones(2)).tolist() == [2.0, 2.0]
    assert double.__name__ == "double"
    assert double.reference(torch.ones(1)).tolist() == [2.0]


def test_a_backend_asked_for_by_name_must_exist(double):
    with (
        use_backend("triton"),
        pytest.raises(BackendUnavailable, match="double: backend 'triton' has no implementation"),
    ):
        double(torch.ones(1))


def test_a_missing_package_is_named(double):
    backends.PROVIDERS["double"] = {"numba": "no_such_package.kernels:double"}
    with (
        use_backend("numba"),
        pytest.raises(BackendUnavailable, match="needs 'no_such_package', which is not installed"),
    ):
        double(torch.ones(1))


def test_auto_falls_back_and_says_so_once(double, caplog):
    backends.PROVIDERS["double"] = {"numba": "no_such_package.kernels:double"}
    with caplog.at_level(logging.INFO, logger="gsfusion_nb.backends"):
        assert double(torch.ones(1)).tolist() == [2.0]
        assert double(torch.ones(1)).tolist() == [2.0]
    assert [r.message for r in caplog.records] == [
        "double: backend 'numba' needs 'no_such_package', which is not installed; using the reference"
    ]


def test_auto_takes_the_fast_one_and_reference_stays_reachable(double):
    backends.PROVIDERS["double"] = {"numba": "torch:square"}
    x = torch.tensor([3.0])
    assert double(x).tolist() == [9.0]
    with use_backend("reference"):
        assert double(x).tolist() == [6.0]
    assert ("double", "numba", "ok") in backends.report()


def test_kernels_that_do_not_compile_are_set_aside_for_all_operations(double, caplog, monkeypatch):
    """What one backend's forward pass has made, another's gradient could not take."""
    monkeypatch.setattr(backends, "_set_aside", set())
    monkeypatch.setattr(backends, "_PREFERRED", {"cpu": ("cuda", "triton")})

    def fails(x):
        raise backends.KernelsUnusable("cuda", "double.cu does not compile")

    made = {("double", "cuda"): fails, ("double", "triton"): torch.square, ("other", "cuda"): fails}
    monkeypatch.setattr(backends, "load", lambda name, backend: made[name, backend])
    backends.PROVIDERS["double"] = {"cuda": "", "triton": ""}
    backends.PROVIDERS["other"] = {"cuda": ""}

    @op
    def other(x: torch.Tensor) -> torch.Tensor:
        """Thrice."""
        return 3 * x

    x = torch.tensor([3.0])
    with caplog.at_level(logging.WARNING, logger="gsfusion_nb.backends"):
        assert double(x).tolist() == [9.0]
        assert double(x).tolist() == [9.0]
        assert other(x).tolist() == [9.0]
    assert [r.message for r in caplog.records] == ["backend 'cuda' is set aside: double.cu does not compile"]
    with use_backend("cuda"), pytest.raises(BackendUnavailable, match="does not compile"):
        double(x)


def test_unknown_backend_lists_the_known():
    with (
        pytest.raises(KeyError, match="no backend 'nubma'; known: auto, cuda, numba, reference, triton"),
        use_backend("nubma"),
    ):
        pass
