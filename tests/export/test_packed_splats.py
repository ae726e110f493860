"""A foreign program reads the PLY files that are written here, and the command that is named for a
packed file makes one of it."""

import csv
import re

import npm_programs
import numpy as np
import pytest
import torch

from gsfusion_nb.export import read_gaussian_ply, write_gaussian_ply
from gsfusion_nb.types import GaussianParams

pytestmark = pytest.mark.ci

N = 300
TOLERANCE_M = {"spz": 1e-3, "sog": 5e-3, "compressed.ply": 5e-3}
"""A packed file keeps positions in 24 bits (spz), or in 11 to 16 bits of its box of 4 m."""


@pytest.fixture
def params(generator) -> GaussianParams:
    """Gaussians of a room of 4 m, with all bands of colour."""

    def between(low: float, high: float, *shape: int) -> torch.Tensor:
        return low + (high - low) * torch.rand(*shape, generator=generator)

    return GaussianParams(
        xyz_W=between(-2.0, 2.0, N, 3),
        log_scale=between(-5.0, -3.0, N, 3),
        quat=torch.nn.functional.normalize(torch.randn(N, 4, generator=generator), dim=1),
        opacity_logit=between(0.0, 3.0, N),
        sh=between(-0.5, 0.5, N, 16, 3),
    )


def test_splat_transform_reads_what_is_written(params, tmp_path):
    write_gaussian_ply(tmp_path / "ours.ply", params)
    npm_programs.splat_transform(tmp_path / "ours.ply", tmp_path / "theirs.csv")
    with (tmp_path / "theirs.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == N

    def columns(*names: str) -> np.ndarray:
        return np.array([[float(row[name]) for name in names] for row in rows])

    np.testing.assert_allclose(columns("x", "y", "z"), params.xyz_W, atol=1e-5)
    np.testing.assert_allclose(
        columns("scale_0", "scale_1", "scale_2"), params.log_scale, atol=1e-5
    )
    np.testing.assert_allclose(columns("opacity")[:, 0], params.opacity_logit, atol=1e-5)
    np.testing.assert_allclose(columns("f_dc_0", "f_dc_1", "f_dc_2"), params.sh[:, 0], atol=1e-5)
    turned = columns("rot_0", "rot_1", "rot_2", "rot_3")
    np.testing.assert_allclose(np.abs((turned * params.quat.numpy()).sum(1)), 1.0, atol=1e-5)


@pytest.mark.parametrize("kind", TOLERANCE_M)
def test_the_named_command_unpacks(params, tmp_path, kind):
    write_gaussian_ply(tmp_path / "ours.ply", params)
    npm_programs.splat_transform(tmp_path / "ours.ply", tmp_path / f"packed.{kind}")
    with pytest.raises(ValueError, match="splat-transform") as refused:
        read_gaussian_ply(tmp_path / f"packed.{kind}")
    command = re.search(r"npx @playcanvas/splat-transform (\S+) (\S+\.ply)", str(refused.value))
    assert command is not None
    packed, plain = (tmp_path / name for name in command.groups())
    npm_programs.splat_transform(packed, plain)
    back = read_gaussian_ply(plain)
    assert len(back) == N
    distances_m = torch.cdist(params.xyz_W, back.xyz_W)  # packed files have an order of their own
    nearest_m, row = distances_m.min(dim=1)
    assert float(nearest_m.max()) < TOLERANCE_M[kind]
    assert len(row.unique()) == N
    assert float((back.log_scale[row] - params.log_scale).abs().max()) < 0.05
    assert (
        float((back.opacity_logit[row].sigmoid() - params.opacity_logit.sigmoid()).abs().max())
        < 0.02
    )
