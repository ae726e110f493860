"""Files of Gaussians that other programs wrote (``tests/export/foreign``), and damaged ones."""

import gzip
import json
import zipfile
from pathlib import Path

import numpy as np
import plyfile
import pytest
import torch
from small_map import small_map

from gsfusion_nb.export import read_gaussians, write_gaussian_ply, write_map_glb
from gsfusion_nb.gaussians.rows import moved
from gsfusion_nb.geometry import quaternion
from gsfusion_nb.types import GaussianParams

FOREIGN = Path(__file__).parent / "foreign"
ROUNDING = {
    # centre (m), scale (its logarithm), rotation (sine of the angle), opacity, constant colour, other coefficients
    "v3.spz": (3e-4, 0.04, 6e-3, 2e-3, 0.03, 0.067),
    "v4.spz": (3e-4, 0.04, 6e-3, 2e-3, 0.03, 0.067),
    "v2.sog": (3e-4, 0.05, 0.025, 4e-3, 0.05, 0.1),
    "packed.compressed.ply": (3e-3, 3e-3, 6e-3, 2e-3, 0.01, 0.03),
    "splats.glb": (1e-6, 1e-6, 1e-6, 1e-6, 1e-6, 1e-6),
}
"""How far each number may be from the source, because the format rounds it; SPZ has 4 bits for a coefficient."""


def in_order_of(read: GaussianParams, source: GaussianParams) -> GaussianParams:
    """The rows sorted as those of the source: some programs sort them along a curve."""
    row = torch.cdist(source.xyz_W.double(), read.xyz_W.double()).argmin(dim=1)
    assert len(row.unique()) == len(source) == len(read)
    return read[row]


@pytest.mark.parametrize("name", ROUNDING)
def test_files_of_another_program_have_the_same_numbers(name):
    source = small_map()
    if name.endswith(".glb"):  # splat-transform turns by 180 degrees about z, from -y up to y up
        source = moved(source, torch.diag(torch.tensor([-1.0, -1, 1])))
    read = in_order_of(read_gaussians(FOREIGN / name), source)
    centre, scale, rotation, opacity, dc, rest = ROUNDING[name]
    assert (read.xyz_W - source.xyz_W).abs().max() <= centre
    assert (read.log_scale - source.log_scale).abs().max() <= scale
    between_axes = quaternion.to_matrix(read.quat).mT @ quaternion.to_matrix(source.quat)  # an axis may point backwards
    assert (between_axes.abs() - torch.eye(3)).abs().max() <= rotation
    assert (read.opacity_logit.sigmoid() - source.opacity_logit.sigmoid()).abs().max() <= opacity
    assert (read.sh[:, 0] - source.sh[:, 0]).abs().max() <= dc
    assert (read.sh[:, 1:] - source.sh[:, 1:]).abs().max() <= rest


def test_splat_by_hand(tmp_path):
    row = np.zeros(2, dtype=[("xyz", "<f4", 3), ("scale", "<f4", 3), ("rgba", "u1", 4), ("quat", "u1", 4)])
    row[0] = ([1, 2, 3], [0.1, 0.2, 0.3], [255, 0, 51, 204], [128, 128, 255, 128])
    row[1] = ([4, 5, 6], [1, 1, 1], [0, 0, 0, 255], [255, 128, 128, 128])
    (tmp_path / "a.splat").write_bytes(row.tobytes())
    read = read_gaussians(tmp_path / "a.splat")
    assert read.xyz_W.tolist() == [[1, 2, 3], [4, 5, 6]]
    assert torch.allclose(read.log_scale.exp(), torch.tensor([[0.1, 0.2, 0.3], [1, 1, 1]]))
    assert torch.allclose(read.opacity_logit.sigmoid(), torch.tensor([0.8, 1.0]), atol=2e-6)
    rgb = read.sh[:, 0] * 0.28209479177387814 + 0.5
    assert torch.allclose(rgb[0], torch.tensor([1.0, 0, 0.2]), atol=1e-6)
    assert torch.allclose(read.quat, torch.tensor([[0.0, 0, 1, 0], [1, 0, 0, 0]]), atol=0.01)
    (tmp_path / "a.splat").write_bytes(row.tobytes()[:-1])
    with pytest.raises(ValueError, match=r"a\.splat has 63 bytes; a \.splat file has a multiple of 32"):
        read_gaussians(tmp_path / "a.splat")


@pytest.mark.parametrize(("text", "order"), [(True, "="), (False, ">"), (False, "<")])
def test_ply_of_other_trainers(tmp_path, text, order):
    """Another order of the properties, none of the normals, properties of its own; ascii, big endian, little endian."""
    g = small_map(9, degree=2)
    columns = {"confidence": g.xyz_W[:, 0], "opacity": g.opacity_logit}
    columns |= {f"rot_{i}": g.quat[:, i] for i in range(4)}
    columns |= {f"f_rest_{c * 8 + k}": g.sh[:, 1 + k, c] for k in range(8) for c in range(3)}
    columns |= {f"f_dc_{c}": g.sh[:, 0, c] for c in range(3)} | {f"scale_{i}": g.log_scale[:, i] for i in (2, 0, 1)}
    columns |= {axis: g.xyz_W[:, i] for i, axis in enumerate("xyz")} | {"label": torch.arange(9)}
    rows = np.zeros(9, dtype=[(name, "i4" if name == "label" else "f4") for name in columns])
    for name, column in columns.items():
        rows[name] = column.numpy()
    cameras = np.zeros(2, dtype=[("id", "u1")])
    elements = [plyfile.PlyElement.describe(cameras, "camera"), plyfile.PlyElement.describe(rows, "vertex")]
    plyfile.PlyData(elements, text=text, byte_order=order).write(str(tmp_path / "g.ply"))
    read = read_gaussians(tmp_path / "g.ply")
    assert read.sh_degree == 2
    for name, column in vars(g).items():
        assert torch.allclose(getattr(read, name), column, rtol=1e-6), name


def test_ply_of_discs_and_of_bytes_for_colours(tmp_path):
    g = small_map(5, degree=0)
    columns = {axis: g.xyz_W[:, i] for i, axis in enumerate("xyz")} | {"opacity": g.opacity_logit}
    columns |= {f"scale_{i}": g.log_scale[:, i] for i in range(2)} | {f"rot_{i}": g.quat[:, i] for i in range(4)}
    rows = np.zeros(5, dtype=[(n, "f4") for n in columns] + [(c, "u1") for c in ("red", "green", "blue")])
    for name, column in columns.items():
        rows[name] = column.numpy()
    rows["green"] = 51
    plyfile.PlyData([plyfile.PlyElement.describe(rows, "vertex")]).write(str(tmp_path / "g.ply"))
    read = read_gaussians(tmp_path / "g.ply")
    assert torch.allclose(read.log_scale[:, 2].exp(), torch.full((5,), 1e-6))
    rgb = read.sh[:, 0] * 0.28209479177387814 + 0.5
    assert torch.allclose(rgb, torch.tensor([0.0, 0.2, 0.0]).expand(5, 3), atol=1e-6)


def test_the_kind_is_told_by_the_content(tmp_path):
    write_gaussian_ply(tmp_path / "no_ending", small_map(3))
    write_map_glb(tmp_path / "wrong.ply", small_map(4))
    assert len(read_gaussians(tmp_path / "no_ending")) == 3
    assert len(read_gaussians(tmp_path / "wrong.ply")) == 4
    (tmp_path / "x.jpg").write_bytes(b"\xff\xd8\xff\xe0 and so on")
    with pytest.raises(ValueError, match=r"x\.jpg begins with .* expected a file of Gaussians \(\.ply, "):
        read_gaussians(tmp_path / "x.jpg")
    with pytest.raises(FileNotFoundError, match=r"nothing\.spz does not exist"):
        read_gaussians(tmp_path / "nothing.spz")


def spz_with(**changes):
    """Bytes of v3.spz with numbers of its header changed."""
    body = bytearray(gzip.decompress((FOREIGN / "v3.spz").read_bytes()))
    places = {"version": (4, 4), "n": (8, 4), "degree": (12, 1), "fraction": (13, 1)}
    for name, value in changes.items():
        start, size = places[name]
        body[start : start + size] = value.to_bytes(size, "little")
    return gzip.compress(bytes(body))


def test_damaged_spz(tmp_path):
    path, whole = tmp_path / "a.spz", (FOREIGN / "v3.spz").read_bytes()
    cases = {
        "is truncated": whole[: len(whole) // 2],
        "cannot be unpacked": whole[:200] + b"\0" * 50 + whole[250:],
        "says it has 4294967295 Gaussians": spz_with(n=2**32 - 1),
        "version 9": spz_with(version=9),
        "degree 200": spz_with(degree=200),
    }
    for sentence, data in cases.items():
        path.write_bytes(data)
        with pytest.raises(ValueError, match=rf"a\.spz.*{sentence}"):
            read_gaussians(path)


def test_damaged_spz_of_version_4(tmp_path):
    path, whole = tmp_path / "a.spz", (FOREIGN / "v4.spz").read_bytes()

    def changed(at: int, value: int, size: int = 4) -> bytes:
        return whole[:at] + value.to_bytes(size, "little") + whole[at + size :]

    cases = {
        "less than a header": whole[:20],
        "an end inside the file; it is truncated or damaged": whole[:-10],
        "cannot be unpacked": whole[:160] + b"\0" * 50 + whole[210:],
        "of version 5": changed(4, 5),
        "degree 7": changed(12, 7, 1),
        "says it has 9 streams": changed(15, 9, 1),
        "says it has 4294967295 Gaussians": changed(8, 2**32 - 1),
        "stream 1 of 6": changed(40, 10**15, 8),
    }
    for sentence, data in cases.items():
        path.write_bytes(data)
        with pytest.raises(ValueError, match=rf"a\.spz.*{sentence}"):
            read_gaussians(path)


def sog_with(path, change, *, without=""):
    """A copy of v2.sog with ``change(meta)`` applied, and without one member."""
    with zipfile.ZipFile(FOREIGN / "v2.sog") as source, zipfile.ZipFile(path, "w") as out:
        for name in source.namelist():
            data = source.read(name)
            if name == "meta.json":
                meta = json.loads(data)
                change(meta)
                data = json.dumps(meta).encode()
            if name != without:
                out.writestr(name, data)


def test_damaged_sog(tmp_path):
    path = tmp_path / "a.sog"
    changes = {
        "has the version 1": lambda m: m.update(version=1),
        "has the count -1": lambda m: m.update(count=-1),
        "pixels for 1000000 Gaussians": lambda m: m.update(count=1_000_000),
        "must have 256 numbers as scales.codebook": lambda m: m["scales"].update(codebook=[0.0]),
        "must name 2 pictures as means.files": lambda m: m["means"].update(files=["means_l.webp"]),
        "has no 'elsewhere.webp'": lambda m: m["quats"].update(files=["elsewhere.webp"]),
        "rows of degree 7": lambda m: m["shN"].update(bands=7),
        "of a palette of 1; damaged": lambda m: m["shN"].update(count=1),
    }
    for sentence, change in changes.items():
        sog_with(path, change)
        with pytest.raises(ValueError, match=rf"a\.sog.*{sentence}"):
            read_gaussians(path)
    sog_with(path, lambda m: None, without="meta.json")
    with pytest.raises(ValueError, match=r"a\.sog has no 'meta\.json'"):
        read_gaussians(path)
    path.write_bytes(b"PK\x03\x04 not a zip file")
    with pytest.raises(ValueError, match=r"a\.sog is not readable as a \.sog file"):
        read_gaussians(path)


def test_damaged_compressed_ply(tmp_path):
    path, whole = tmp_path / "a.ply", (FOREIGN / "packed.compressed.ply").read_bytes()
    path.write_bytes(whole[:-100])
    with pytest.raises(ValueError, match=r"a\.ply"):
        read_gaussians(path)
    path.write_bytes(whole.replace(b"packed_scale", b"packed_sizes"))
    with pytest.raises(ValueError, match=r"a\.ply has 1 groups for 40 Gaussians and lacks packed_scale"):
        read_gaussians(path)
