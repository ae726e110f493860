"""Every CUDA source compiles for its GPUs without a warning; and through NVRTC where that is at
hand."""

import importlib.util
import re
from pathlib import Path

import pytest

from gsfusion_nb.backends import BackendUnavailable

KERNELS = Path(__file__).resolve().parents[2] / "kernels"
pytestmark = pytest.mark.ci

SOURCES = sorted(KERNELS.glob("*/*.cu"))


@pytest.mark.parametrize("source", SOURCES, ids=lambda p: p.name)
def test_sources_need_no_headers_but_their_own(source, emulator):
    """NVRTC has no folder to search: it is given the .cuh files, and nothing else."""
    included = re.findall(r'#include\s+["<](.*?)[">]', source.read_text(encoding="utf-8"))
    assert set(included) <= {path.name for path in KERNELS.glob("*/*.cuh")}
    assert emulator.kernels_of(source)


@pytest.fixture
def nvrtc():
    """The module, without its package, which asks for a GPU."""
    spec = importlib.util.spec_from_file_location(
        "nvrtc_alone", KERNELS / "runtime" / "cuda" / "nvrtc.py"
    )
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def at_hand(nvrtc):
    try:
        nvrtc.library()
    except BackendUnavailable as e:
        pytest.skip(str(e))
    return nvrtc


@pytest.mark.parametrize("source", SOURCES, ids=lambda p: p.name)
def test_nvrtc_compiles_and_keeps(source, at_hand, emulator, tmp_path, monkeypatch):
    monkeypatch.setenv("GSFUSION_CACHE", str(tmp_path))
    image = at_hand.compile_source(source.stem, (9, 0))
    for kernel in emulator.kernels_of(source):
        assert kernel.encode() in image
    (kept,) = (tmp_path / "cuda").iterdir()
    assert kept.name.startswith(f"{source.stem}-sm_90-")
    kept.write_bytes(b"kept")
    assert at_hand.compile_source(source.stem, (9, 0)) == b"kept"


def test_nvrtc_gives_ptx_for_gpus_that_it_does_not_know(at_hand, tmp_path, monkeypatch):
    monkeypatch.setenv("GSFUSION_CACHE", str(tmp_path))
    assert b".entry count_tiles" in at_hand.compile_source("binning", (99, 0))
    with pytest.raises(
        BackendUnavailable, match=r"a GPU of compute capability .* or more, got 1.0"
    ):
        at_hand.compile_source("binning", (1, 0))


def test_a_source_with_a_mistake_is_quoted(at_hand, tmp_path, monkeypatch):
    monkeypatch.setattr(at_hand, "KERNELS", tmp_path)
    (tmp_path / "wrong").mkdir()
    (tmp_path / "wrong" / "wrong.cu").write_text(
        'extern "C" __global__ void wrong() { nonsense(); }'
    )
    with pytest.raises(RuntimeError, match=r"(?s)wrong.cu does not compile with .*sm_90.*nonsense"):
        at_hand.compile_source("wrong", (9, 0))
