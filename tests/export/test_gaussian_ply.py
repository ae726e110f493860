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
        xyz_W=rand(n, 3),
        log_scale=rand(n, 3),
        quat=rand(n, 4),
        opacity_logit=rand(n),
        sh=rand(n, (degree + 1) ** 2, 3),
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
    assert row.tolist() == [
        1,
        2,
        3,
        0,
        0,
        0,
        0,
        1,
        2,
        *red,
        *green,
        *blue,
        11,
        4,
        5,
        6,
        7,
        8,
        9,
        10,
    ]


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
    columns |= {f"scale_{i}": g.log_scale[:, i] for i in range(3)} | {
        f"rot_{i}": g.quat[:, i] for i in range(4)
    }
    rows = np.zeros(4, dtype=[(name, "f8") for name in columns])
    for name, column in columns.items():
        rows[name] = column.numpy()
    plyfile.PlyData([plyfile.PlyElement.describe(rows, "vertex")], byte_order=">").write(
        str(tmp_path / "g.ply")
    )
    back = read_gaussian_ply(tmp_path / "g.ply")
    assert back.sh_degree == degree
    assert torch.equal(back.sh, g.sh)
    assert torch.equal(back.quat, g.quat)


def test_errors_are_sentences(tmp_path, generator):
    path = tmp_path / "g.ply"
    with pytest.raises(
        FileNotFoundError, match=r"g\.ply does not exist; expected a PLY file of Gaussians"
    ):
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


@pytest.mark.parametrize(
    ("column", "value"),
    [("xyz_W", 5.9e34), ("log_scale", 86.0), ("quat", 0.0)],
)
def test_gaussians_that_no_map_has_are_refused_with_their_row(tmp_path, generator, column, value):
    params = gaussians(3, 0, generator)
    getattr(params, column)[1] = value
    write_gaussian_ply(tmp_path / "g.ply", params)
    with pytest.raises(ValueError, match="row 1"):
        read_gaussian_ply(tmp_path / "g.ply", strict=True)
    getattr(params, column)[:] = value
    write_gaussian_ply(tmp_path / "g.ply", params)
    with pytest.raises(ValueError, match="row 0"):
        read_gaussian_ply(tmp_path / "g.ply")  # none is left


def columns_of(params):
    """The properties of a file by name, as another trainer may write them."""
    rest = params.sh[:, 1:].transpose(1, 2).reshape(len(params), -1)
    columns = {
        "opacity": params.opacity_logit,
        **{a: params.xyz_W[:, i] for i, a in enumerate("xyz")},
    }
    columns |= {f"f_dc_{c}": params.sh[:, 0, c] for c in range(3)}
    columns |= {f"f_rest_{i}": rest[:, i] for i in range(rest.shape[1])}
    columns |= {f"scale_{i}": params.log_scale[:, i] for i in range(3)}
    columns |= {f"rot_{i}": params.quat[:, i] for i in range(4)}
    return {name: column.double().numpy() for name, column in columns.items()}


def write_columns(path, columns, *, dtype="f4", comments=()):
    rows = np.zeros(
        len(next(iter(columns.values()))),
        dtype=[(name, dtype) for name in columns],
    )
    for name, column in columns.items():
        rows[name] = column
    plyfile.PlyData([plyfile.PlyElement.describe(rows, "vertex")], comments=list(comments)).write(
        str(path)
    )
    return path


@pytest.mark.parametrize("name", ["filter_3D", "filter_3d"])
def test_a_smoothing_filter_is_applied(tmp_path, generator, caplog, name):
    """Mip-Splatting, Eq. 9: sqrt(|S| / |S + f^2 I|) exp(-x^T (S + f^2 I)^-1 x / 2), by hand for two
    Gaussians."""
    g = gaussians(2, 0, generator)
    g.log_scale[:] = torch.log(torch.tensor([[0.03, 0.04, 0.12], [0.01, 0.01, 0.01]]))
    g.opacity_logit[:] = torch.logit(torch.tensor([0.9, 0.5]))
    path = write_columns(
        tmp_path / "g.ply",
        columns_of(g) | {name: np.array([0.04, 0.0])},
    )
    back = read_gaussian_ply(path)
    wide = torch.tensor(
        [[0.05, (2 * 0.04**2) ** 0.5, (0.12**2 + 0.04**2) ** 0.5], [0.01, 0.01, 0.01]]
    )
    assert torch.allclose(back.log_scale.exp(), wide, rtol=1e-5)
    peak = 0.9 * (0.03 * 0.04 * 0.12) / float(wide[0].prod())
    assert torch.allclose(
        back.opacity_logit.sigmoid(),
        torch.tensor([peak, 0.5]),
        rtol=1e-5,
    )
    assert f"{name} was applied" in caplog.text


@pytest.mark.parametrize(
    ("comment", "named"),
    [
        ("SplatRenderMode: mip", "mip"),
        ("splatrendermode:  Banana", "Banana"),
        ("antialiased 1", "mip"),
        ("SplatRenderMode: default", ""),
        ("antialiased 0", ""),
        ("Exported from Brush", ""),
    ],
)
def test_another_mode_of_rendering_is_named(tmp_path, generator, caplog, comment, named):
    read_gaussian_ply(
        write_columns(
            tmp_path / "g.ply", columns_of(gaussians(2, 0, generator)), comments=[comment]
        )
    )
    assert (
        f"trained for the render mode {named}, which this package does not have" in caplog.text
    ) == bool(named)
    assert bool(caplog.text) == bool(named)


@pytest.mark.parametrize(
    ("comment", "told"),
    [
        ("units: mm", True),
        ("offset 500000 5400000 0", True),
        ("Vertical axis: z", True),
        ("EPSG:25832", True),
        ("Generated by a splat trainer", False),
    ],
)
def test_a_comment_on_places_is_named(tmp_path, generator, caplog, comment, told):
    columns = columns_of(gaussians(2, 0, generator))
    read_gaussian_ply(write_columns(tmp_path / "g.ply", columns, comments=[comment]))
    assert (f"its comment {comment!r} is not used" in caplog.text) == told


@pytest.mark.parametrize(
    ("changed", "told"),
    [
        ("", ""),
        ("scale", "its scales are all between 0 and 1"),
        ("opacity", "its opacities are all between 0 and 1"),
    ],
)
def test_numbers_that_were_activated_are_doubted(tmp_path, generator, caplog, changed, told):
    """Lengths in place of their logarithms, and opacities in place of their logits."""
    columns = columns_of(gaussians(200, 0, generator))
    for i, name in enumerate(("scale_0", "scale_1", "scale_2")):
        columns[name] = np.linspace(0.001, 0.5, 200) + i / 100
        if changed != "scale":
            columns[name] = np.log(columns[name])
    columns["opacity"] = np.linspace(0.01, 0.99, 200)
    if changed != "opacity":
        columns["opacity"] = np.log(columns["opacity"] / (1 - columns["opacity"]))
    read_gaussian_ply(write_columns(tmp_path / "g.ply", columns))
    assert told in caplog.text
    assert bool(caplog.text) == bool(told)


def test_places_of_a_survey_are_moved_and_not_rounded(tmp_path, generator, caplog):
    """677 northings were 6 in float32; here none is off by more than 0.1 mm."""
    g = gaussians(200, 0, generator)
    columns = columns_of(g)
    columns["x"] = columns["x"] + 500123.25
    columns["y"] = columns["y"] + 5400456.5
    path = write_columns(tmp_path / "g.ply", columns, dtype="f8")
    back = read_gaussian_ply(path)
    moved = np.array(
        [float(word) for word in caplog.text.split("moved by (")[1].split(")")[0].split(",")]
    )
    assert moved[2] == 0
    stored = np.stack([columns[axis] for axis in "xyz"], axis=1)
    assert np.abs(stored + moved - back.xyz_W.double().numpy()).max() < 1e-4
    assert back.xyz_W.abs().max() < 10
    with pytest.raises(
        ValueError, match=r"has places near \(5001\d\d, 54004\d\d, 0\), which float32 would round"
    ):
        read_gaussian_ply(path, keep_place=True)
    caplog.clear()
    read_gaussian_ply(write_columns(path, columns))
    assert "have steps of 0.5 as the file stores them" in caplog.text


def test_one_bad_row_leaves_the_others(tmp_path, generator, caplog):
    g = gaussians(8, 1, generator)
    g.xyz_W[1] = float("nan")
    g.quat[2] = 0.0
    g.xyz_W[3] = 5e8
    g.log_scale[4] = 90.0
    g.opacity_logit[5] = float("inf")
    g.log_scale[6, 2] = -float("inf")
    write_gaussian_ply(tmp_path / "g.ply", g)
    back = read_gaussian_ply(tmp_path / "g.ply")
    kept = [0, 5, 6, 7]
    assert torch.equal(back.xyz_W, g.xyz_W[kept])
    assert torch.equal(back.sh[:, :4], g.sh[kept])
    assert back.opacity_logit.sigmoid()[1] == 1.0
    assert all(bool(column.isfinite().all()) for column in vars(back).values())
    assert float(back.log_scale[2, 2].exp()) < 1e-8
    for told in (
        "4 of 8 Gaussians were left out",
        "1 with NaN or infinities, the first in row 1",
        "1 with a rotation whose quaternion is zero, the first in row 2",
        "1 with a place beyond 1e+07, the first in row 3",
        "1 with a size above 1e+07, the first in row 4",
    ):
        assert told in caplog.text
    with pytest.raises(ValueError, match=r"contains NaN or infinities, the first is x of row 1"):
        read_gaussian_ply(tmp_path / "g.ply", strict=True)
    beyond = columns_of(gaussians(3, 0, generator))
    beyond["x"][1] = 1e300  # infinite as float32
    assert len(read_gaussian_ply(write_columns(tmp_path / "g.ply", beyond, dtype="f8"))) == 2


@pytest.mark.parametrize(
    ("name", "head"),
    [
        ("a.spz", b"\x1f\x8b\x08"),
        ("b.bin", b"NGSP\x04"),
        ("c.splat", b"\0" * 64),
        ("d.ksplat", b"\0\1" + b"\0" * 62),
        ("e.sog", b"PK\x03\x04"),
    ],
)
def test_packed_formats_name_what_makes_a_ply(tmp_path, name, head):
    (tmp_path / name).write_bytes(head)
    with pytest.raises(ValueError, match=rf"npx @playcanvas/splat-transform {name} {name[0]}\.ply"):
        read_gaussian_ply(tmp_path / name)


def test_other_kinds_of_gaussians_are_named(tmp_path, generator, caplog):
    columns = columns_of(gaussians(3, 0, generator))
    flat = {name: column for name, column in columns.items() if name != "scale_2"}
    zeros = np.zeros(3)
    for kind, changed in (
        ("2D Gaussian Splatting", flat),
        ("anchors of Scaffold-GS", columns | {"f_anchor_feat_0": zeros}),
        ("Gaussians that move in time", columns | {"trbf_center": zeros}),
        ("Gaussians that move in time", columns | {"t": zeros}),
    ):
        with pytest.raises(ValueError, match=kind):
            read_gaussian_ply(write_columns(tmp_path / "g.ply", changed))
    read_gaussian_ply(
        write_columns(tmp_path / "g.ply", columns | {"nx": zeros, "red": zeros, "label": zeros})
    )
    assert not caplog.text
    read_gaussian_ply(write_columns(tmp_path / "g.ply", columns | {"reflectance": zeros}))
    assert "the properties reflectance are not known and not used" in caplog.text
    packed = np.zeros(3, dtype=[("packed_position", "u4")])
    chunk = plyfile.PlyElement.describe(np.zeros(1, dtype=[("min_x", "f4")]), "chunk")
    vertex = plyfile.PlyElement.describe(packed, "vertex")
    plyfile.PlyData([chunk, vertex]).write(str(tmp_path / "g.compressed.ply"))
    with pytest.raises(
        ValueError, match=r"is a compressed PLY; .*splat-transform g\.compressed\.ply plain\.ply"
    ):
        read_gaussian_ply(tmp_path / "g.compressed.ply")
