"""A stepper through the march along one ray of a TSDF volume."""

from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ...drawing.curves import BETWEEN, PALETTE, style
from ...geometry import rays, se3
from ...tsdf import TsdfVolume, raycast
from ...types import Camera
from ..panels.pixel_blend import camera_of_pixel, check_pixel
from ..panels.tsdf import distance_colours
from .recording import Recording, record
from .stepper import Step, Stepper, text_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure


RAY_WATCH = {
    raycast: {
        "raycast": ("depth_m", "normal_W", "rgb"),
        "_surface_depths": (
            "z",
            "point_W",
            "D",
            "allocated",
            "D_before",
            "enters",
            "leaves",
            "step",
        ),
        "_distance_at": (
            "volume.voxel_index(point_W)",
            "voxel",
            "volume.W.view(-1)[voxel]",
            "close",
        ),
        "_zero_crossing": ("z", "z0", "z1", "D0", "D1", "D"),
    }
}


def raycast_stepper(
    volume: TsdfVolume,
    camera: Camera,
    T_WC: Float[Tensor, "4 4"],
    pixel: tuple[int, int],
) -> Stepper:
    """Press Next along one ray: the voxel, its D and W, how far to the next sample, the sign
    change, the depth.

    Above: D in a plane through the ray, red behind a surface, blue in front of it, empty where
    nothing is known. Below: the D that the ray met so far.

    Args:
        volume: The map.
        camera, T_WC: As for ``raycast``.
        pixel: Column and row of the ray.

    Raises:
        ValueError: the pixel is outside the image, or the volume is empty.
    """
    check_pixel(camera, *pixel)
    one = camera_of_pixel(camera, *pixel)
    recording = record(lambda: raycast(volume, one, T_WC), RAY_WATCH)
    steps = [*_march(recording), *_interpolate(recording)]
    end = recording.at("return RaycastOutput")[0]
    depth_m = float(end["depth_m"])
    result = f"the surface is at z = {depth_m:.4f} m" if depth_m else "this ray meets no surface"
    numbers = [("depth z", f"{depth_m:.5f} m"), ("normal", text_of(end["normal_W"][0], 3))]
    steps.append(Step(end, f"The result of this pixel: {result}.", numbers, steps[-1].scene))
    plane = _plane(
        volume,
        one,
        T_WC,
        max(float(s.scene["z"]) for s in steps) + 0.25,
    )
    return Stepper(
        steps,
        lambda figure, scene: _ray_picture(figure, scene, plane),
        name="raycast",
        label=f"Raycast of pixel {pixel}",
    )


def _march(recording: Recording) -> list[Step]:
    steps = []
    z_met = []
    D_met = []
    looks = [
        line for line in recording if line.function == "_distance_at" and "return" in line.values
    ]
    samples = recording.at("D, allocated = _distance_at")
    turns = recording.at("leaves = ")
    advances = recording.at("step = torch.where")
    for look, sample, turn, advance in zip(looks, samples, turns, advances, strict=True):
        z = float(sample["z"])
        D = float(sample["D"])
        is_allocated = bool(sample["allocated"])
        voxel = tuple(look["volume.voxel_index(point_W)"][0].tolist())
        z_met = [*z_met, z]
        D_met = [*D_met, D]
        scene = {"z": z, "z_met": z_met, "D_met": D_met, "next": None, "bracket": None}
        W = float(look["volume.W.view(-1)[voxel]"]) if is_allocated else 0.0
        numbers = [
            ("depth z", f"{z:.4f} m"),
            ("point", text_of(sample["point_W"][0]) + " m"),
            ("voxel", str(voxel)),
            ("block", "allocated" if is_allocated else "not allocated"),
            ("W", text_of(W)),
            ("D", text_of(D)),
        ]
        what = (
            "no block is allocated here: nothing is known"
            if not is_allocated
            else f"D = {D:.3f}, W = {W:.0f}"
        )
        if is_allocated and not W:
            what = "its block is allocated, but this voxel was never observed"
        elif bool(look["close"]):
            what += ", interpolated because the surface is near"
        steps.append(Step(sample, f"Sample {len(z_met)}: {what}.", numbers, scene))
        D_before = text_of(float(turn["D_before"]))
        if bool(turn["enters"]) or bool(turn["leaves"]):
            where = (
                "from + to −: a surface"
                if bool(turn["enters"])
                else "from − to +: the back of a surface"
            )
            signs = [("D before", D_before), ("D", text_of(D))]
            steps.append(
                Step(turn, f"D changes {where} is between these two samples.", signs, scene)
            )
            break
        step = float(advance["step"])
        at = scene | {"next": z + float(advance["step"])}
        how = (
            "0.7 of the stored distance, at least one voxel"
            if is_allocated
            else "to where the ray leaves this block"
        )
        next_numbers = [
            ("step", f"{step:.4f} m"),
            ("next z", f"{z + step:.4f} m"),
            ("D before", D_before),
        ]
        steps.append(
            Step(
                advance, f"No sign change. Advance by {100 * step:.1f} cm: {how}.", next_numbers, at
            )
        )
    return steps


def _interpolate(recording: Recording) -> list[Step]:
    """The linear interpolation and its refinements; none for a ray that met no surface."""
    lines = [
        line for line in recording if line.text.startswith("z = z0 + (z1 - z0)") and len(line["z"])
    ]
    last = recording.at("D, allocated = _distance_at")
    z_met = [float(s["z"]) for s in last]
    D_met = [float(s["D"]) for s in last]
    steps = []
    for k, line in enumerate(lines):
        z0, z1, D0, D1 = (float(line[name]) for name in ("z0", "z1", "D0", "D1"))
        scene = {
            "z": float(line["z"]),
            "z_met": z_met,
            "D_met": D_met,
            "next": None,
            "bracket": (z0, z1, D0, D1),
        }
        names = [("z0, z1", f"{z0:.4f}, {z1:.4f} m"), ("D0, D1", f"{text_of(D0)}, {text_of(D1)}")]
        how = "A straight line through the two samples is zero here"
        if k:
            how = (
                f"Refinement {k}: the interpolated D at the last guess replaces the end that has "
                "the same sign"
            )
            names.append(("D at the last guess", text_of(float(line["D"]))))
        steps.append(Step(line, f"{how}.", [*names, ("z", f"{scene['z']:.5f} m")], scene))
    return steps


def _plane(
    volume: TsdfVolume, one: Camera, T_WC: Tensor, far_m: float, half_m: float = 0.3
) -> dict[str, Any]:
    """D in the plane of the ray and the camera's y axis: the image and its extent."""
    ray_C = rays(one, torch.tensor([0.5, 0.5]))
    z = torch.linspace(0, far_m, 450)
    y = torch.linspace(-half_m, half_m, 100)
    points_C = z[None, :, None] * ray_C + y[:, None, None] * torch.tensor([0.0, 1.0, 0.0])
    samples = volume.sample_nearest(se3.apply(T_WC.float(), points_C).view(-1, 3).to(volume.device))
    D = samples.D.view(100, 450).cpu().numpy()
    W = samples.W.view(100, 450).cpu().numpy()
    ground = np.where(W > 0, 255, 0).astype(np.uint8)[..., None]
    return {
        "X": np.concatenate([distance_colours(D), ground], axis=2),
        "extent": (0.0, far_m, half_m, -half_m),
    }


def _ray_picture(
    figure: "Figure",
    scene: dict[str, Any],
    plane: dict[str, Any],
) -> None:
    plane_axes = figure.add_axes((0.12, 0.66, 0.86, 0.28))
    graph_axes = figure.add_axes((0.12, 0.13, 0.86, 0.43))
    plane_axes.imshow(**plane, aspect="auto", interpolation="nearest")
    style(plane_axes, title="D in a plane through the ray (red −, blue +)")
    style(graph_axes, x="depth z, m", y="D")
    plane_axes.set_yticks([])
    orange = PALETTE[1]
    red = PALETTE[3]
    z = scene["z"]
    bracket = scene["bracket"]
    D_met = np.array(scene["D_met"])
    D = 0.0 if bracket else D_met[-1]
    for axes, height in ((plane_axes, 0), (graph_axes, 1)):
        axes.axhline(0, color=BETWEEN, linewidth=0.8)
        axes.plot(scene["z_met"], height * D_met, "o", color=orange, markersize=4)
        axes.plot(
            z,
            height * D,
            "o",
            color=red,
            markersize=8,
            fillstyle="none",
            mew=2,
        )
        if scene["next"]:
            axes.plot(
                [z, scene["next"]],
                [height * np.nan_to_num(D)] * 2,
                color=orange,
                linewidth=2,
            )
    if bracket:
        graph_axes.plot(
            bracket[:2],
            bracket[2:],
            "--",
            color=red,
            linewidth=1.4,
        )
    far_m = plane["extent"][1]
    graph_axes.set(
        ylim=(-1.1, 1.1),
        xlim=(bracket[0] - 0.02, bracket[1] + 0.02) if bracket else (0.0, far_m),
    )
