"""Without a GPU the CUDA kernels are compiled for the CPU, where fibres stand in for the threads of
a block."""

import importlib.util
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from gsfusion_nb import backends
from gsfusion_nb.backends import BackendUnavailable, offers, use_backend
from gsfusion_nb.render import render_forward
from gsfusion_nb.types import Camera, GaussianParams

ROOT = Path(__file__).resolve().parents[2]
FOLDERS = (
    "tests/kernels/cuda",
    "tests/kernels/gpu",
    "tests/kernels/test_parity.py::test_same_as_the_reference",
)


def run_emulated(library: Path, **environment: str) -> str:
    """Run tests/kernels/cuda on the emulator; what pytest printed."""
    if "GSFUSION_CUDA_EMULATOR" in os.environ:
        pytest.skip("tests/kernels/cuda run in this session already")
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", *FOLDERS],
        cwd=ROOT,
        env={**os.environ, "GSFUSION_CUDA_EMULATOR": str(library), **environment},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stdout[-8000:] + done.stderr[-8000:]
    return done.stdout


@pytest.mark.ci
@pytest.mark.skipif(
    torch.cuda.is_available(), reason="there is a GPU: tests/kernels/cuda run on it"
)
def test_kernels_on_the_cpu(emulator_library):
    assert " passed" in run_emulated(emulator_library)


@pytest.mark.slow
def test_kernels_stay_inside_their_arrays(emulator, emulator_library, tmp_path):
    """The same under the address and undefined-behaviour sanitizers."""
    environment, extra = emulator.sanitizer()
    assert " passed" in run_emulated(emulator.build(tmp_path, extra), **environment)


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_without_a_gpu_it_says_so(monkeypatch):
    """Asked for by name; ``auto`` goes on without."""
    monkeypatch.delenv("GSFUSION_CUDA_EMULATOR", raising=False)
    camera = Camera(
        width=4,
        height=4,
        fx=4.0,
        fy=4.0,
        cx=2.0,
        cy=2.0,
    )
    params = GaussianParams(
        xyz_W=torch.zeros(1, 3),
        log_scale=torch.zeros(1, 3),
        quat=torch.ones(1, 4),
        opacity_logit=torch.zeros(1),
        sh=torch.zeros(1, 1, 3),
    )
    backends.look_again()
    with (
        use_backend("cuda"),
        pytest.raises(BackendUnavailable, match="'cuda' needs an NVIDIA GPU, and torch sees none"),
    ):
        render_forward(params, camera, torch.eye(4))


ON_AN_AMD_GPU = """
import torch
torch.cuda.is_available, torch.version.hip = lambda: True, "6.4"
from gsfusion_nb import backends, optim, render, tsdf
operations = ("render_forward", "render_vjp", "band_blocks", "disc_depth")
print([backends.automatic(name, "cuda") for name in operations])
"""


def test_on_an_amd_gpu_the_reference_takes_their_place():
    """Each operation asks, and each is refused."""
    environment = {k: v for k, v in os.environ.items() if k not in offers.EMULATED_BY.values()}
    done = subprocess.run(
        [sys.executable, "-c", ON_AN_AMD_GPU], capture_output=True, text=True, env=environment
    )
    triton = "triton" if importlib.util.find_spec("triton") else "reference"
    assert done.stdout.strip() == str(["reference", "reference", "reference", triton]), done.stderr
