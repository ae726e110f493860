"""tsdf.npz: a volume comes back as it was rounded, compact, and a file that is not in order is
refused."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from gsfusion_nb.config import TsdfConfig
from gsfusion_nb.export import read_tsdf, write_tsdf
from gsfusion_nb.export.tsdf_file import as_stored
from gsfusion_nb.files import archives
from gsfusion_nb.tsdf import TsdfVolume, integrate, raycast
from gsfusion_nb.types import Camera, Frame

CONFIG = TsdfConfig(voxel_size_m=0.05, truncation_voxels=4.0)
CAMERA = Camera(
    width=64,
    height=48,
    fx=50.0,
    fy=50.0,
    cx=32.0,
    cy=24.0,
)


@pytest.fixture(scope="module")
def volume() -> TsdfVolume:
    """A slanted wall, seen twice."""
    v, u = torch.meshgrid(
        torch.arange(48.0),
        torch.arange(64.0),
        indexing="ij",
    )
    rgb = torch.stack(
        [u / 64, v / 48, (u + v) % 7 / 7],
        dim=-1,
    )
    wall = TsdfVolume(CONFIG)
    for index in range(2):
        depth_m = 1.5 + 0.004 * u + 0.001 * index
        integrate(
            wall,
            Frame(
                index=index,
                timestamp_s=0.0,
                rgb=rgb,
                depth_m=depth_m,
                camera=CAMERA,
                T_WC=torch.eye(4),
            ),
        )
    return wall


def test_a_volume_comes_back_as_it_was_rounded_and_its_picture_hardly_changes(volume, tmp_path):
    path = tmp_path / "tsdf.npz"
    write_tsdf(path, volume)
    back = read_tsdf(path, CONFIG)
    rounded = as_stored(volume)
    for name in ("D", "W", "rgb_planes", "block_coords"):
        assert torch.equal(getattr(back, name), getattr(rounded, name)), name
    observed = volume.W > 0
    assert torch.equal(back.W, volume.W)
    assert float((back.D - volume.D)[observed].abs().max()) <= 0.5 / 32767
    assert float((back.rgb - volume.rgb)[observed].abs().max()) <= 0.501 / 255
    before = raycast(volume, CAMERA, torch.eye(4))
    after = raycast(back, CAMERA, torch.eye(4))
    assert torch.equal(before.depth_m > 0, after.depth_m > 0)
    assert float((before.rgb - after.rgb).abs().max()) < 0.01
    assert path.stat().st_size < 8 * int(observed.sum())


def test_an_empty_volume_is_stored(tmp_path):
    write_tsdf(tmp_path / "tsdf.npz", TsdfVolume(CONFIG))
    assert read_tsdf(tmp_path / "tsdf.npz", CONFIG).n_blocks == 0


def _cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-200])


def _changed(path: Path, **columns: Any) -> None:
    with np.load(path) as archive:
        stored: dict[str, Any] = dict(archive)
    np.savez_compressed(path, **(stored | columns))


@pytest.mark.parametrize(
    ("damage", "says"),
    [
        (_cut, "not readable as the TSDF of a run"),
        (lambda path: path.unlink(), "does not exist; expected the TSDF of a run"),
        (lambda path: path.write_text("voxels"), "not readable as the TSDF of a run"),
        (
            lambda path: _changed(path, voxel_size_m=np.float64(0.01)),
            "but the settings of the run say 0.05",
        ),
        (
            lambda path: _changed(path, D=np.zeros(3, np.int16)),
            "W is .* of float16, expected .3. of float16",
        ),
        (lambda path: _changed(path, W=np.load(path)["W"] * np.float16("nan")), "W"),
        (
            lambda path: _changed(path, block_coords=np.load(path)["block_coords"] * 0),
            "every block once",
        ),
    ],
)
def test_a_file_that_is_not_in_order_is_refused(damage, says, volume, tmp_path):
    path = tmp_path / "tsdf.npz"
    write_tsdf(path, volume)
    damage(path)
    with pytest.raises((ValueError, FileNotFoundError), match=says):
        read_tsdf(path, CONFIG)


def test_a_small_file_cannot_ask_for_much_memory(tmp_path, monkeypatch):
    """Blocks of nothing, and an archive that unpacks to a thousand times its size."""
    monkeypatch.setattr(archives, "LEAST_MEMORY_BYTES", 1 << 20)
    n = 100_000
    coords = np.zeros((n, 3), np.int32)
    coords[:, 0] = np.arange(n)
    nothing: dict[str, Any] = {
        "D": np.zeros(0, np.int16),
        "W": np.zeros(0, np.float16),
        "rgb": np.zeros((3, 0), np.uint8),
    }
    size: dict[str, Any] = {
        "voxel_size_m": CONFIG.voxel_size_m,
        "truncation_m": CONFIG.truncation_m,
    }
    path = tmp_path / "tsdf.npz"
    np.savez_compressed(
        path,
        block_coords=coords,
        observed=np.zeros((n, 64), np.uint8),
        **nothing,
        **size,
    )
    with pytest.raises(ValueError, match=r"tsdf\.npz of .* MB asks for 3\.1 GB of memory"):
        read_tsdf(path, CONFIG)
    np.savez_compressed(
        path,
        block_coords=coords[:1],
        D=np.zeros(5_000_000, np.int8),
        **size,
    )
    with pytest.raises(ValueError, match=r"tsdf\.npz of .* MB asks for 0\.0 GB of memory"):
        read_tsdf(path, CONFIG)
