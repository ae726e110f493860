"""Without a GPU the Triton kernels run under Triton's interpreter, which has to be chosen before
Python starts."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch

ROOT = Path(__file__).resolve().parents[2]
FOLDERS = ("tests/kernels/triton", "tests/kernels/test_parity.py::test_same_as_the_reference")


@pytest.mark.ci
@pytest.mark.skipif(
    torch.cuda.is_available(), reason="there is a GPU: tests/kernels/triton run on it"
)
def test_kernels_under_the_interpreter():
    pytest.importorskip("triton", reason="triton is not installed (pip install 'gsfusion-nb[gpu]')")
    if "TRITON_INTERPRET" in os.environ:
        pytest.skip("tests/kernels/triton run in this session already")
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", *FOLDERS],
        cwd=ROOT,
        env={**os.environ, "TRITON_INTERPRET": "1"},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stdout[-6000:] + done.stderr[-2000:]
    assert " passed" in done.stdout
