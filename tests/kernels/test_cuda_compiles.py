"""Every CUDA source compiles for its GPUs without a warning; and through NVRTC where that is at hand."""

import importlib.util
import re
import shutil
import subprocess
from pathlib import Path

import pytest

from gsfusion_nb.backends import BackendUnavailable

KERNELS = Path(__file__).resolve().parents[2] / "kernels"
pytestmark = pytest.mark.ci

SOURCES = sorted(KERNELS.glob("*/*.cu"))


@pytest.mark.parametrize("architecture", ["sm_80", "sm_90"])
@pytest.mark.parametrize("source", SOURCES, ids=lambda p: p.name)
def test_nvcc_has_nothing_to_say(source, architecture, emulator, tmp_path):
    nvcc = shutil.which("nvcc")
    if nvcc is None:
        pytest.skip("nvcc is not installed")
    flags = [
        "-std=c++17",
        "--fmad=false",
        "-Werror",
        "all-warnings",
        "-Xptxas",
        "-warn-spills,-warn-lmem-usage,-Werror",
    ]
    target = tmp_path / "kernels.cubin"
    command = [
        nvcc,
        f"-arch={architecture}",
        "-cubin",
        *flags,
        *emulator.options(),
        *emulator.includes(),
        str(source),
        "-o",
        str(target),
    ]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-6000:]
    assert not (done.stdout + done.stderr).strip(), done.stderr
    assert target.stat().st_size > 0


@pytest.mark.parametrize("source", SOURCES, ids=lambda p: p.name)
def test_sources_need_no_headers_but_their_own(source, emulator):
    """NVRTC has no folder to search: it is given the .cuh files, and nothing else."""
    included = re.findall(r'#include\s+["<](.*?)[">]', source.read_text(encoding="utf-8"))
    assert set(included) <= {path.name for path in KERNELS.glob("*/*.cuh")}
    assert emulator.kernels_of(source)


@pytest.fixture
def nvrtc():
    """The module, without its package, which asks for a GPU."""
    spec = importlib.util.spec_from_file_location("nvrtc_alone", KERNELS / "runtime" / "cuda" / "nvrtc.py")
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
    with pytest.raises(BackendUnavailable, match=r"a GPU of compute capability .* or more, got 1.0"):
        at_hand.compile_source("binning", (1, 0))


def test_a_source_with_a_mistake_is_quoted(at_hand, tmp_path, monkeypatch):
    monkeypatch.setattr(at_hand, "KERNELS", tmp_path)
    (tmp_path / "wrong").mkdir()
    (tmp_path / "wrong" / "wrong.cu").write_text('extern "C" __global__ void wrong() { nonsense(); }')
    with pytest.raises(RuntimeError, match=r"(?s)wrong.cu does not compile with .*sm_90.*nonsense"):
        at_hand.compile_source("wrong", (9, 0))


def test_without_nvrtc_it_says_so(nvrtc, monkeypatch):
    def missing(name):
        raise OSError(name)

    monkeypatch.setattr(nvrtc.ctypes, "CDLL", missing)
    with pytest.raises(BackendUnavailable, match=r"'cuda' needs NVRTC \(.*nvrtc.*\), which is neither in torch's"):
        nvrtc.library()
