"""Which tensors the backends for GPUs take, and what they say of others."""

import importlib

import pytest
import torch

from gsfusion_nb.backends import BackendUnavailable


@pytest.fixture
def launch(backend):
    return importlib.import_module(f"gsfusion_nb.kernels.runtime.{backend}.launch")


def test_tensors_on_two_devices_are_refused(launch, device):
    here, elsewhere = torch.zeros(3, device=device), torch.zeros(3, device="meta")
    with pytest.raises(ValueError, match=f"add: all tensors must be on one device, got a on {device}.*, b on meta"):
        launch.device_of("add", a=here, b=elsewhere)


def test_other_devices_are_refused(launch, backend):
    with pytest.raises(BackendUnavailable, match=f"add: backend '{backend}' takes CUDA tensors, got tensors on meta"):
        launch.device_of("add", a=torch.zeros(3, device="meta"), b=None)
