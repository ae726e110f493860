"""The 62-property PLY of 3D Gaussian splatting."""

import numpy as np
import plyfile
import pytest
import torch

from gsfusion_nb.export import read_gaussian_ply, write_gaussian_ply
from gsfusion_nb.types import GaussianParams

NAMES = (
    ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
    + [f"f_rest_{i}" for i in range(45)]
    + ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
)


def gaussians(n, degree, generator):
    def rand(*shape):
        return torch.randn(*shape, generator=generator)

    return GaussianParams(
        xyz_W=rand(n, 3), log_scale=rand(n, 3), quat=rand(n, 4), opacity_logit=rand(n), sh=rand(n, (degree + 1) ** 2, 3)
    )


@pytest.mark.parametrize("n", [0, 1, 7])
def test_header_and_size_literally(tmp_path, n, generator):
    path = tmp_path / "g.ply"
    write_gaussian_ply(path, gaussians(n, 3, generator))
    header = "".join(
        ["ply\n", "format binary_little_endian 1.0\n", f"element vertex {n}\n"]
        + [f"property float {name}\n" for name in NAMES]
        + ["end_header\n"]
    ).encode()
    data = path.read_bytes()
    assert data[: len(header)] == header
    assert len(data) == len(header) + 248 * n


def test_bytes_of_one_gaussian_by_hand(tmp_path):
    sh = torch.arange(48.0).reshape(1, 16, 3)
    one = GaussianParams(
        xyz_W=torch.tensor([[1.0, 2, 3]]),
        log_scale=torch.tensor([[4.0, 5, 6]]),
        quat=torch.tensor([[7.0, 8, 9, 10]]),
        opacity_logit=torch.tensor([11.0]),
        sh=sh,
    )
    write_gaussian_ply(tmp_path / "g.ply", one)
    row = np.frombuffer((tmp_path / "g.ply").read_bytes()[-248:], "<f4")
    red, green, blue = ([float(3 * k + c) for k in range(1, 16)] for c in range(3))  # channel-major
    assert row.tolist() == [1, 2, 3, 0, 0, 0, 0, 1, 2, *red, *green, *blue, 11, 4, 5, 6, 7, 8, 9, 10]


@pytest.mark.parametrize("n", [0, 1, 9])
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_round_trip_pads_to_degree_3(tmp_path, generator, n, degree):
    g = gaussians(n, degree, generator)
    write_gaussian_ply(tmp_path / "g.ply", g)
    back = read_gaussian_ply(tmp_path / "g.ply")
    assert len(back) == n
    assert back.sh_degree == 3
    k = (degree + 1) ** 2
    assert torch.equal(back.sh[:, :k], g.sh)
    assert not back.sh[:, k:].any()
    for name in ("xyz_W", "log_scale", "quat", "opacity_logit"):
        assert torch.equal(getattr(back, name), getattr(g, name))


@pytest.mark.parametrize("degree", [0, 1, 2])
def test_reads_files_of_lower_degree_and_float64_and_big_endian(tmp_path, generator, degree):
    g = gaussians(4, degree, generator)
    k = (degree + 1) ** 2 - 1
    columns = {"opacity": g.opacity_logit, **{a: g.xyz_W[:, i] for i, a in enumerate("xyz")}}
    columns |= {f"f_dc_{c}": g.sh[:, 0, c] for c in range(3)}
    columns |= {f"f_rest_{c * k + j}": g.sh[:, 1 + j, c] for c in range(3) for j in range(k)}
    columns |= {f"scale_{i}": g.log_scale[:, i] for i in range(3)} | {f"rot_{i}": g.quat[:, i] for i in range(4)}
    rows = np.zeros(4, dtype=[(name, "f8") for name in columns])
    for name, column in columns.items():
        rows[name] = column.numpy()
    plyfile.PlyData([plyfile.PlyElement.describe(rows, "vertex")], byte_order=">").write(str(tmp_path / "g.ply"))
    back = read_gaussian_ply(tmp_path / "g.ply")
    assert back.sh_degree == degree
    assert torch.equal(back.sh, g.sh)
    assert torch.equal(back.quat, g.quat)


def test_errors_are_sentences(tmp_path, generator):
    path = tmp_path / "g.ply"
    with pytest.raises(FileNotFoundError, match=r"g\.ply does not exist; expected a PLY file of Gaussians"):
        read_gaussian_ply(path)
    path.write_text("hello")
    with pytest.raises(ValueError, match=r"g\.ply is not .*readable .*PLY file"):
        read_gaussian_ply(path)
    rows = np.zeros(2, dtype=[(name, "f4") for name in ("x", "y", "z")])
    plyfile.PlyData([plyfile.PlyElement.describe(rows, "vertex")]).write(str(path))
    with pytest.raises(ValueError, match=r"has no properties f_dc_0, .*rot_3"):
        read_gaussian_ply(path)
    write_gaussian_ply(path, gaussians(3, 0, generator))
    path.write_bytes(path.read_bytes()[:-10])
    with pytest.raises(ValueError, match="early end-of-file"):
        read_gaussian_ply(path)


@pytest.mark.parametrize(("column", "value"), [("xyz_W", 5.9e34), ("log_scale", 86.0), ("quat", 0.0)])
def test_gaussians_that_no_map_has_are_refused_with_their_row(tmp_path, generator, column, value):
    params = gaussians(3, 0, generator)
    getattr(params, column)[1] = value
    write_gaussian_ply(tmp_path / "g.ply", params)
    with pytest.raises(ValueError, match="row 1"):
        read_gaussian_ply(tmp_path / "g.ply")
