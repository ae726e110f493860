import pytest
import torch

from gsfusion_nb.backends import use_backend
from gsfusion_nb.config import TsdfConfig
from gsfusion_nb.tsdf import TsdfVolume, sample_voxels

pytest.importorskip("numba")


def random_volume(generator: torch.Generator) -> TsdfVolume:
    volume = TsdfVolume(TsdfConfig(voxel_size_m=0.05))
    volume.add_blocks(torch.randint(-3, 4, (40, 3), generator=generator))
    for field in (volume.D, volume.W, volume.rgb_planes):
        field.copy_(torch.rand(field.shape, generator=generator))
    return volume


@pytest.mark.parametrize("n", [0, 1, 5000])
def test_samples_are_the_same(n, generator):
    volume = random_volume(generator)
    points = 0.7 * torch.randn(n, 3, generator=generator)
    if n > 3:
        points[:3] = torch.tensor([[torch.nan, 0.0, 0.0], [1e30, 0.0, 0.0], [-0.0, 0.05, -0.05]])
    results = []
    for backend in ("reference", "numba"):
        with use_backend(backend):
            results.append(
                sample_voxels(volume, points[2 if backend == "reference" and n > 3 else 0 :])
            )
    a, b = results
    skip = 2 if n > 3 else 0
    for name in ("D", "W", "rgb"):
        assert torch.equal(getattr(a, name), getattr(b, name)[skip:])
    if n > 3:
        assert b.W[:2].tolist() == [0.0, 0.0]
        assert 0.01 < float((b.W > 0).double().mean()) < 0.9
