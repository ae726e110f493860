"""Without a GPU, whole maps are made on tensors that say they are on one: see tests/kernels/pretend."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.ci
@pytest.mark.skipif(torch.version.cuda is not None, reason="this torch is built for CUDA and looks for a GPU")
def test_both_systems_on_a_pretended_gpu(emulator_library):
    pytest.importorskip("triton", reason="triton is not installed (pip install 'gsfusion-nb[gpu]')")
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "tests/kernels/pretend"],
        cwd=ROOT,
        env={**os.environ, "GSFUSION_CUDA_EMULATOR": str(emulator_library), "TRITON_INTERPRET": "1"},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stdout[-8000:] + done.stderr[-2000:]
    assert " passed" in done.stdout
