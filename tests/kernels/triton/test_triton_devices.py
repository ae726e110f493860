"""Which tensors the kernels take, and what they say of others."""

import os
import subprocess
import sys

import pytest
import torch

from gsfusion_nb import backends
from gsfusion_nb.backends import dispatch, offers, use_backend
from gsfusion_nb.optim import dssim_vjp


def test_tensors_on_two_devices_are_refused(device):
    with (
        use_backend("triton"),
        pytest.raises(ValueError, match=r"dssim_vjp: target must be on .*, got a tensor on "),
    ):
        dssim_vjp(
            torch.zeros(4, 4, 3, device=device),
            torch.zeros(4, 4, 3, device="meta"),
        )


def test_cuda_tensors_are_found_wherever_they_are(make_scene, make_camera, pose, monkeypatch):
    """A map or a frame is on its tensors' device; a pose may be anywhere."""
    monkeypatch.setitem(offers.PREFERRED, "meta", ("triton",))
    # nothing is remembered
    monkeypatch.setattr(dispatch, "automatic", backends.automatic.__wrapped__)
    scene = make_scene(2, 0)
    there = type(scene)(**{name: value.to("meta") for name, value in vars(scene).items()})
    chosen = dispatch._implementation("disc_depth", (there, make_camera(4, 4), pose), {})
    assert chosen is backends.load("disc_depth", "triton")
    assert (
        dispatch._implementation(
            "disc_depth",
            (scene, make_camera(4, 4), pose),
            {},
        )
        is not chosen
    )


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_without_gpu_and_interpreter_it_says_so():
    environment = {k: v for k, v in os.environ.items() if k != "TRITON_INTERPRET"}
    code = (
        "import torch\nfrom gsfusion_nb.backends import BackendUnavailable, use_backend\n"
        "from gsfusion_nb.optim import dssim_vjp\n"
        "try:\n    with use_backend('triton'): dssim_vjp(torch.zeros(4, 4, 3), torch.zeros(4, 4, "
        "3))\n"
        "except BackendUnavailable as e: print(e)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        check=True,
        env=environment,
    )
    assert "backend 'triton' needs an NVIDIA GPU, and torch sees none" in done.stdout
