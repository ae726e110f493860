"""Gaussians, mesh and cameras in one OpenUSD stage as text (``.usda``), upright, in metres.

Gaussians are a ``ParticleField3DGaussianSplat`` (OpenUSD 26.03 and later): standard deviations in
metres and opacities 0..1, not their logarithm and logit, rotations wxyz, and the coefficients of
the colour in the order of Kerbl et al.
2023. The stage has y up. Its root has the rotation that takes the map there, and below it are the
  numbers of the map
unchanged. USD multiplies row vectors from the left, so its matrices are the transposes of ours.
"""

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ..errors import ArgumentError
from ..files import atomic_file
from ..geometry import quaternion
from ..geometry.spherical_harmonics import SH_C0
from ..geometry.upright import Up, turn_to_y_up
from ..types import Camera, GaussianParams, Mesh
from .glb import check_gaussians, linear_rgb

APERTURE = 20.955
"""Width of the film, as USD has it by default; only the ratios of the other lengths to it count."""
_OF_POINTS = ' (\n            interpolation = "vertex"\n        )'
ROWS = 100_000
"""Rows of an array that are turned into text at a time."""


def write_map_usda(
    path: str | Path,
    gaussians: GaussianParams,
    mesh: Mesh | None = None,
    *,
    camera: Camera | None = None,
    poses: Float[Tensor, "F 4 4"] | None = None,
    times_s: Sequence[float] = (),
    up: Up = "-y",
) -> None:
    """Write Gaussians, and a mesh and a moving camera if given, as one ``.usda`` file, atomically.

    Text takes four times the bytes of ``map.glb``. ``usdcat map.usda -o map.usdc`` makes a binary
    file of it.

    Args:
        path: File to write.
        gaussians: The map; may be empty.
        mesh: Its surface. Colours are stored as linear RGB, as USD requires.
        camera: Intrinsics of the camera that moves along ``poses``.
        poses: Camera-to-world, OpenCV axes, metres.
        times_s: Time of each pose, seconds. [F]
        up: Direction of the map's world that points up: the name of an axis, or three numbers.

    Raises:
        ValueError: a Gaussian with NaN or infinities, or another number of times than of poses.
    """
    check_gaussians(gaussians)
    if poses is not None and len(times_s) != len(poses):
        raise ArgumentError(
            f"times_s must hold {len(poses)} times, one per pose, got {len(times_s)}"
        )
    R = torch.eye(4, dtype=torch.float64)
    R[:3, :3] = turn_to_y_up(up)
    with atomic_file(path) as temporary, temporary.open("w", encoding="ascii") as file:
        ends = (
            ""
            if not len(times_s)
            else f"    startTimeCode = {times_s[0]!r}\n    endTimeCode = {times_s[-1]!r}\n"
        )
        file.write(
            '#usda 1.0\n(\n    defaultPrim = "Map"\n    metersPerUnit = 1\n    upAxis = "Y"\n'
            f'    timeCodesPerSecond = 1\n{ends})\n\ndef Xform "Map"\n{{\n    matrix4d '
            "xformOp:transform = "
            f'{_matrix(R)}\n    uniform token[] xformOpOrder = ["xformOp:transform"]\n'
        )
        if len(gaussians):
            file.writelines(_splats(gaussians))
        if mesh is not None and len(mesh.faces):
            file.writelines(_surface(mesh))
        if camera is not None and poses is not None:
            file.writelines(_camera(camera, poses, times_s))
        file.write("}\n")


def _splats(g: GaussianParams) -> Iterator[str]:
    scale = g.log_scale.double().exp()
    degree = round(g.sh.shape[1] ** 0.5) - 1
    reach = 3 * scale.amax(1, keepdim=True)
    ends = torch.stack([(g.xyz_W - reach).amin(0), (g.xyz_W + reach).amax(0)])
    yield '\n    def ParticleField3DGaussianSplat "Gaussians"\n    {\n'
    yield from _array("float3[] extent", ends)
    yield from _array("point3f[] positions", g.xyz_W)
    yield from _array("quatf[] orientations", quaternion.normalise(g.quat.double()))
    yield from _array("float3[] scales", scale)
    yield from _array("float[] opacities", g.opacity_logit.double().sigmoid())
    yield f"        uniform int radiance:sphericalHarmonicsDegree = {degree}\n"
    yield from _array("float3[] radiance:sphericalHarmonicsCoefficients", g.sh.flatten(0, 1))
    # for programs that do not know splats
    colour = torch.from_numpy(linear_rgb(g.sh[:, 0].double() * SH_C0 + 0.5))
    yield from _array("color3f[] primvars:displayColor", colour, _OF_POINTS)
    yield "    }\n"


def _surface(mesh: Mesh) -> Iterator[str]:
    colour = torch.from_numpy(linear_rgb(mesh.rgb))
    yield '\n    def Mesh "Surface"\n    {\n        uniform token subdivisionScheme = "none"\n'
    yield "        uniform bool doubleSided = 1\n"
    yield from _array(
        "float3[] extent",
        torch.stack([mesh.vertices_W.amin(0), mesh.vertices_W.amax(0)]),
    )
    yield from _array("point3f[] points", mesh.vertices_W)
    yield from _array("int[] faceVertexCounts", torch.full((len(mesh.faces),), 3))
    yield from _array("int[] faceVertexIndices", mesh.faces.flatten())
    yield from _array("color3f[] primvars:displayColor", colour, _OF_POINTS)
    yield "    }\n"


def _camera(
    camera: Camera, poses: Float[Tensor, "F 4 4"], times_s: Sequence[float]
) -> Iterator[str]:
    """USD's cameras look along -z with y up; a ray of pixel (u, v) goes through the film at
    distance focalLength."""
    c = camera
    focal = APERTURE * camera.fx / camera.width
    width_of_pixel = focal / c.fx  # of a pixel on the film
    height_of_pixel = focal / c.fy
    T_usd = poses.double().cpu() @ torch.diag(
        torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64)
    )
    yield '\n    def Camera "Camera"\n    {\n        token projection = "perspective"\n'
    yield "        float2 clippingRange = (0.01, 1000)\n"
    lengths = {
        "focalLength": focal,
        "horizontalAperture": APERTURE,
        "verticalAperture": height_of_pixel * c.height,
    }
    lengths |= {"horizontalApertureOffset": width_of_pixel * (c.width / 2 - c.cx)}
    lengths |= {"verticalApertureOffset": height_of_pixel * (c.cy - c.height / 2)}
    for name, value in lengths.items():
        yield f"        float {name} = {value:.9g}\n"
    yield "        matrix4d xformOp:transform.timeSamples = {\n"
    for time_s, T in zip(times_s, T_usd, strict=True):
        yield f"            {time_s!r}: {_matrix(T)},\n"
    yield '        }\n        uniform token[] xformOpOrder = ["xformOp:transform"]\n    }\n'


def _matrix(T: Float[Tensor, "4 4"]) -> str:
    rows = (f"({', '.join(map(repr, row))})" for row in T.double().T.tolist())
    return f"( {', '.join(rows)} )"


def _array(declaration: str, values: Tensor, suffix: str = "") -> Iterator[str]:
    """An attribute: tuples of [N, K] or numbers of [N]; nine digits keep every bit of float32."""
    yield f"        {declaration} = ["
    for start in range(0, len(values), ROWS):
        part = values[start : start + ROWS].detach().cpu()
        number = "%d" if not part.is_floating_point() else "%.9g"
        form = number if part.ndim == 1 else f"({', '.join([number] * part.shape[1])})"
        rows = np.asarray(part if number == "%d" else part.float()).tolist()
        yield ", " * (start > 0) + ", ".join(
            form % (row if part.ndim == 1 else tuple(row)) for row in rows
        )
    yield f"]{suffix}\n"
