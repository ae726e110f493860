"""A ``.glb`` with Gaussians and mesh in the Khronos validator, and drawn by PlayCanvas and Babylon
as we draw it.

``GSNB_RUN=runs/room-... pytest -m ci -s tests/browser/test_gltf_engines.py`` does the same with the
maps of a run and prints the PSNR; pictures go to $GSNB_SCREENSHOTS.
"""

import json
import math
import os
import subprocess
from pathlib import Path
from urllib.parse import quote

import cv2
import npm_programs
import numpy as np
import pytest
import torch

from gsfusion_nb.export import read_gaussian_ply, read_mesh_ply, read_trajectory_tum, write_map_glb
from gsfusion_nb.geometry import quaternion
from gsfusion_nb.geometry.upright import turn_to_y_up, world_up
from gsfusion_nb.render import render
from gsfusion_nb.types import Camera, GaussianParams, Mesh

pytestmark = pytest.mark.ci
_GL = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
CAMERA = Camera(
    width=320,
    height=240,
    fx=230.0,
    fy=230.0,
    cx=160.0,
    cy=120.0,
)


def box_room() -> tuple[GaussianParams, Mesh, torch.Tensor]:
    """A floor and two walls of coloured Gaussians with z up, the floor also as a mesh, and a camera
    pose."""
    u, v = (
        c.flatten()
        for c in torch.meshgrid(
            torch.linspace(-1, 1, 36),
            torch.linspace(-1, 1, 36),
            indexing="ij",
        )
    )
    one = torch.ones_like(u)
    xyz = torch.cat([torch.stack(p, 1) for p in ((u, v, 0 * u), (u, one, v + 1), (one, u, v + 1))])
    flat = [[0.03, 0.03, 0.005], [0.03, 0.005, 0.03], [0.005, 0.03, 0.03]]
    sh = torch.zeros(len(xyz), 16, 3)
    checks = ((xyz * 3).floor().sum(1) % 2)[:, None]
    sh[:, 0] = torch.cat(
        [xyz[:, :1], xyz[:, 1:2] * checks, xyz[:, 2:]],
        1,
    )
    sh[:, 1:] = 0.15 * torch.randn(1, 15, 3, generator=torch.Generator().manual_seed(1))
    gaussians = GaussianParams(
        xyz_W=xyz,
        log_scale=torch.tensor(flat).log().repeat_interleave(len(u), 0),
        quat=torch.tensor([[1.0, 0, 0, 0]]).repeat(len(xyz), 1),
        opacity_logit=torch.full((len(xyz),), 3.0),
        sh=sh,
    )
    corners = torch.tensor([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    faces = torch.tensor(
        [[0, 1, 2], [0, 2, 3]],
        dtype=torch.int32,
    )
    mesh = Mesh(
        vertices_W=corners,
        faces=faces,
        rgb=torch.tensor([[0.8, 0.1, 0.1], [0.1, 0.7, 0.1], [0.1, 0.1, 0.9], [0.5, 0.5, 0.5]]),
    )
    z = torch.nn.functional.normalize(torch.tensor([0.6, 0.7, -0.35]), dim=0)
    x = torch.nn.functional.normalize(
        torch.linalg.cross(z, torch.tensor([0.0, 0, 1])),
        dim=0,
    )
    T = torch.eye(4)
    T[:3, 0] = x
    T[:3, 1] = torch.linalg.cross(z, x)
    T[:3, 2] = z
    T[:3, 3] = torch.tensor([-1.7, -1.9, 1.7])
    return gaussians, mesh, T


def scene() -> tuple[GaussianParams, Mesh, torch.Tensor, torch.Tensor]:
    """The map to test with, a camera pose in it, and its up direction."""
    if "GSNB_RUN" not in os.environ:
        gaussians, mesh, T_WC = box_room()
        return gaussians, mesh, T_WC, torch.tensor([0.0, 0, 1])
    folder = Path(os.environ["GSNB_RUN"])
    _, poses = read_trajectory_tum(folder / "trajectory.txt")
    mesh = read_mesh_ply(folder / "mesh.ply")
    return (
        read_gaussian_ply(folder / "gaussians.ply"),
        mesh,
        poses[len(poses) // 2].float(),
        world_up(list(poses)),
    )


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """Folder of the ``.glb``, the Gaussians, the pose, and the address of a page's view of it by
    what is hidden."""
    folder = tmp_path_factory.mktemp("glb")
    gaussians, mesh, T_WC, up = scene()
    write_map_glb(folder / "map.glb", gaussians, mesh, up=up)
    T = torch.eye(4)
    T[:3] = turn_to_y_up(up).float() @ T_WC[:3]
    # OpenGL axes of a camera
    w, x, y, z = quaternion.from_matrix(T[:3, :3] * torch.tensor([1.0, -1, -1])).tolist()
    view = {
        "file": "/files/map.glb",
        "width": CAMERA.width,
        "height": CAMERA.height,
        "fov_deg": math.degrees(2 * math.atan(CAMERA.height / 2 / CAMERA.fy)),
        "position": T[:3, 3].tolist(),
        "rotation_xyzw": [x, y, z, w],
        "forward": T[:3, 2].tolist(),
        "up": (-T[:3, 1]).tolist(),
    }
    return folder, gaussians, T_WC, view


@pytest.fixture(scope="module")
def browser(launch):
    browser = launch(_GL)
    yield browser
    browser.close()


def say(sentence: str) -> None:
    """Show a number, with pytest -s."""
    print(f"\n{sentence}")  # noqa: T201


def psnr_db(a: np.ndarray, b: np.ndarray) -> float:
    return -10 * math.log10(max(float(((a - b) ** 2).mean()), 1e-12))


def drawn(browser, written, engine: str, hide: str) -> np.ndarray:
    """The picture of an engine, 0..1."""
    folder, _, _, view = written
    node_modules = npm_programs.npm_folder(
        *{"playcanvas": ["playcanvas"], "babylon": ["@babylonjs/core", "@babylonjs/loaders"]}[
            engine
        ]
    )
    with npm_programs.server(folder, node_modules) as address:
        page = browser.new_page(viewport={"width": CAMERA.width, "height": CAMERA.height})
        errors: list[str] = []
        page.on("pageerror", lambda e: errors.append(str(e)))
        page.goto(f"{address}/{engine}.html?view={quote(json.dumps(view | {'hide': hide}))}")
        page.wait_for_function("window.done !== undefined", timeout=300_000)
        assert page.evaluate("window.done") == {"splats": 1, "meshes": 1}
        assert errors == []
        png = page.locator("canvas").screenshot()
        page.close()
    if "GSNB_SCREENSHOTS" in os.environ:
        Path(
            os.environ["GSNB_SCREENSHOTS"], f"{engine}-without-{hide or 'nothing'}.png"
        ).write_bytes(png)
    picture = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR)
    assert picture is not None
    return picture[..., ::-1].astype(np.float64) / 255


@pytest.mark.parametrize("engine", ["playcanvas", "babylon"])
def test_engines_draw_the_gaussians_as_we_do(browser, written, engine):
    _, gaussians, T_WC, _ = written
    ours = render(gaussians, CAMERA, T_WC).rgb.clamp(0, 1).double().numpy()
    theirs = drawn(browser, written, engine, "surface")
    say(
        f"{engine}, {len(gaussians)} Gaussians: PSNR {psnr_db(ours, theirs):.1f} dB against our "
        "picture"
    )
    assert psnr_db(ours, theirs) > 25
    for wrong in (
        ours[::-1],
        ours[:, ::-1],
        ours[..., ::-1],
    ):  # upside down, mirrored, red for blue
        assert psnr_db(ours, theirs) > psnr_db(wrong, theirs) + 6


@pytest.mark.parametrize("engine", ["playcanvas", "babylon"])
def test_the_mesh_lies_where_the_gaussians_are(browser, written, engine):
    _, gaussians, T_WC, _ = written
    theirs = drawn(browser, written, engine, "Gaussians")
    covered = theirs.max(-1) > 0.02
    if "GSNB_RUN" in os.environ:
        ours = render(gaussians, CAMERA, T_WC).rgb.clamp(0, 1).double().numpy()
        say(
            f"{engine}, mesh: PSNR {psnr_db(ours[covered], theirs[covered]):.1f} dB against our "
            "Gaussians"
        )
        assert psnr_db(ours[covered], theirs[covered]) > 18
        return
    corners = torch.tensor([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    seen = (corners - T_WC[:3, 3]) @ T_WC[:3, :3]
    pixels = (seen[:, :2] / seen[:, 2:] * CAMERA.fx + torch.tensor([CAMERA.cx, CAMERA.cy])).numpy()
    wanted = np.zeros(covered.shape, np.uint8)
    cv2.fillConvexPoly(wanted, pixels.round().astype(np.int32), 1)
    assert (covered == wanted.astype(bool)).mean() > 0.99
    middle = np.clip(
        pixels.mean(0).round().astype(int),
        0,
        None,
    )
    assert covered[middle[1], middle[0]]


def issues_of(path: Path) -> list[dict]:
    """What the Khronos validator says about a file."""
    script = (
        "const v = require('gltf-validator'), fs = require('fs');"
        "v.validateBytes(new Uint8Array(fs.readFileSync(process.argv[1])), {maxIssues: 200})"
        ".then(r => console.log(JSON.stringify(r)));"
    )
    done = subprocess.run(
        ["node", "-e", script, str(path)],
        capture_output=True,
        text=True,
        check=True,
        timeout=300,
        cwd=npm_programs.npm_folder("gltf-validator").parent,
    )
    return json.loads(done.stdout)["issues"]["messages"]


def test_the_khronos_validator_finds_no_error(written, tmp_path):
    """The published validator (2.0.0-dev.3.10) does not know the extension, and therefore not the
    names of its attributes. With names that it takes as those of an application, it checks all the
    rest.
    """
    issues = issues_of(written[0] / "map.glb")
    errors = [i for i in issues if i["severity"] == 0]
    assert {i["code"] for i in issues} == {
        "UNSUPPORTED_EXTENSION",
        "MESH_PRIMITIVE_INVALID_ATTRIBUTE",
    }
    assert all("/attributes/KHR_gaussian_splatting:" in i["pointer"] for i in errors)
    data = (written[0] / "map.glb").read_bytes()
    assert data.count(b'"KHR_gaussian_splatting:') == len(errors)
    (tmp_path / "renamed.glb").write_bytes(
        data.replace(b'"KHR_gaussian_splatting:', b'"_HR_gaussian_splatting_')
    )
    assert {i["code"] for i in issues_of(tmp_path / "renamed.glb")} == {"UNSUPPORTED_EXTENSION"}
