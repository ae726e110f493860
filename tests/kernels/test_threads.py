"""Whose threads the kernels run on, and that the map does not depend on it."""

import importlib.metadata
import os
import subprocess
import sys

import pytest

HAS_TBB = any(d.metadata["Name"] == "tbb" for d in importlib.metadata.distributions())

PROGRAM = """
import hashlib, torch
torch.set_num_threads(2)
import numba
from gsfusion_nb import GSFusion, gsfusion, open_sequence
from gsfusion_nb.backends import kernel_threads

frames = open_sequence("room", n_frames=40, width=64, height=48)
mapper = GSFusion(gsfusion("room"))
for i in range(3):
    mapper.step(frames[i])
bits = hashlib.sha256()
surface = mapper.surface(frames.camera, frames[1].T_WC)
for values in (mapper.gaussians.params.xyz_W, mapper.volume.D, surface.depth_m):
    bits.update(values.contiguous().numpy().tobytes())
print(kernel_threads()[0], numba.threading_layer(), bits.hexdigest())
"""


def _run(**environment: str) -> list[str]:
    environment = {**os.environ, "OMP_NUM_THREADS": "2", **environment}
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM], capture_output=True, text=True, env=environment
    )
    assert done.returncode == 0, done.stderr[-2000:]
    return done.stdout.split()


@pytest.mark.ci
@pytest.mark.skipif(not HAS_TBB, reason="tbb is not installed: it has no wheel for this machine")
def test_maps_of_both_kinds_of_threads_have_the_same_bits():
    ours, used, bits = _run()
    assert ours == used == "tbb"
    plain = _run(NUMBA_THREADING_LAYER="workqueue")
    assert plain == ["workqueue", "workqueue", bits]
