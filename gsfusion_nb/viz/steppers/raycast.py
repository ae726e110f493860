"""A stepper along one ray: march through the voxels until D changes its sign, then interpolate."""

import dataclasses
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ...drawing.curves import BETWEEN, PALETTE
from ...geometry import rays, se3
from ...tsdf import TsdfVolume, raycast
from ...types import Camera
from ..panels.tsdf_slice import distance_colours
from .recording import Recording, record
from .stepper import Step, Stepper, moving, step_of, style, text_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure

WATCH = {
    raycast: {
        "raycast": ("depth_m", "normal_W", "rgb"),
        "_surface_depths": (
            "z",
            "point_W",
            "D",
            "allocated",
            "z_before",
            "D_before",
            "enters",
            "leaves",
            "step",
            "ray",
        ),
        "_distance_at": ("volume.voxel_index(point_W)", "at", "volume.W.view(-1)[at]", "close"),
        "_zero_crossing": ("z", "z0", "z1", "D0", "D1", "D"),
    }
}


def record_ray(
    volume: TsdfVolume, camera: Camera, T_WC: Float[Tensor, "4 4"], pixel: tuple[int, int]
) -> tuple[Recording, Camera]:
    """``raycast`` of one pixel: a recording, and the camera whose only pixel it is."""
    u, v = pixel
    if not (0 <= u < camera.width and 0 <= v < camera.height):
        raise ValueError(f"pixel {pixel} is outside an image of {camera.width} x {camera.height}")
    one = dataclasses.replace(camera, width=1, height=1, cx=camera.cx - u, cy=camera.cy - v)
    return record(lambda: raycast(volume, one, T_WC), WATCH), one


def raycast_stepper(volume: TsdfVolume, camera: Camera, T_WC: Float[Tensor, "4 4"], pixel: tuple[int, int]) -> Stepper:
    """Press Next along one ray: the voxel, its D and W, how far to the next sample, the sign change, the depth.

    Above: D in a plane through the ray, red behind a surface, blue in front of it, empty where nothing is known.
    Below: the D that the ray met so far.

    Args:
        volume: The map.
        camera, T_WC: As for ``raycast``.
        pixel: Column and row of the ray.

    Raises:
        ValueError: the pixel is outside the image, or the volume is empty.
    """
    recording, one = record_ray(volume, camera, T_WC, pixel)
    steps = [*_march(recording), *_interpolate(recording)]
    end = recording.at("return RaycastOutput")[0]
    depth_m = float(end["depth_m"])
    found = f"the surface is at z = {depth_m:.4f} m" if depth_m else "this ray meets no surface"
    numbers = [("depth z", f"{depth_m:.5f} m"), ("normal", text_of(end["normal_W"][0], 3))]
    steps.append(step_of(end, f"The result of this pixel: {found}.", numbers, steps[-1].scene))
    plane = _Plane(volume, one, T_WC, max(float(s.scene["z"]) for s in steps) + 0.25)
    return Stepper(
        steps, lambda figure: _picture(figure, plane, steps), name="raycast", label=f"Raycast of pixel {pixel}",
        stills=(min(6, len(steps) - 1), max(len(steps) - 6, 0), len(steps) - 1),
    )  # fmt: skip


def _march(recording: Recording) -> list[Step]:
    steps, z_met, D_met = [], [], []
    looks = [line for line in recording if line.function == "_distance_at" and "return" in line.values]
    samples = recording.at("D, allocated = _distance_at")
    turns = recording.at("enters, leaves = ")
    advances = recording.at("step = torch.where")
    for look, sample, turn, advance in zip(looks, samples, turns, advances, strict=True):
        z, D = float(sample["z"]), float(sample["D"])
        known, voxel = bool(sample["allocated"]), tuple(look["volume.voxel_index(point_W)"][0].tolist())
        z_met, D_met = [*z_met, z], [*D_met, D]
        scene = {"z": z, "z_met": z_met, "D_met": D_met, "next": None, "bracket": None}
        W = float(look["volume.W.view(-1)[at]"]) if known else 0.0
        numbers = [
            ("depth z", f"{z:.4f} m"), ("point", text_of(sample["point_W"][0]) + " m"), ("voxel", str(voxel)),
            ("block", "allocated" if known else "not allocated"), ("W", text_of(W)), ("D", text_of(D)),
        ]  # fmt: skip
        what = "no block is allocated here: nothing is known" if not known else f"D = {D:.3f}, W = {W:.0f}"
        if known and not W:
            what = "its block is allocated, but this voxel was never observed"
        elif bool(look["close"]):
            what += ", interpolated because the surface is near"
        steps.append(step_of(sample, f"Sample {len(z_met)}: {what}.", numbers, scene))
        D_before = text_of(float(turn["D_before"]))
        if bool(turn["enters"]) or bool(turn["leaves"]):
            where = "from + to −: a surface" if bool(turn["enters"]) else "from − to +: the back of a surface"
            signs = [("D before", D_before), ("D", text_of(D))]
            steps.append(step_of(turn, f"D changes {where} is between these two samples.", signs, scene))
            break
        step, at = float(advance["step"]), scene | {"next": z + float(advance["step"])}
        how = "0.7 of the stored distance, at least one voxel" if known else "to where the ray leaves this block"
        ahead = [("step", f"{step:.4f} m"), ("next z", f"{z + step:.4f} m"), ("D before", D_before)]
        steps.append(step_of(advance, f"No sign change. Advance by {100 * step:.1f} cm: {how}.", ahead, at))
    return steps


def _interpolate(recording: Recording) -> list[Step]:
    """The linear interpolation and its refinements; none for a ray that met no surface."""
    lines = [line for line in recording if line.text.startswith("z = z0 + (z1 - z0)") and len(line["z"])]
    last = recording.at("D, allocated = _distance_at")
    z_met, D_met = [float(s["z"]) for s in last], [float(s["D"]) for s in last]
    steps = []
    for k, line in enumerate(lines):
        z0, z1, D0, D1 = (float(line[name]) for name in ("z0", "z1", "D0", "D1"))
        scene = {"z": float(line["z"]), "z_met": z_met, "D_met": D_met, "next": None, "bracket": (z0, z1, D0, D1)}
        names = [("z0, z1", f"{z0:.4f}, {z1:.4f} m"), ("D0, D1", f"{text_of(D0)}, {text_of(D1)}")]
        how = "A straight line through the two samples is zero here"
        if k:
            how = f"Refinement {k}: the interpolated D at the last guess replaces the end that has the same sign"
            names.append(("D at the last guess", text_of(float(line["D"]))))
        steps.append(step_of(line, f"{how}.", [*names, ("z", f"{scene['z']:.5f} m")], scene))
    return steps


class _Plane:
    """D in the plane of the ray and the camera's y axis."""

    def __init__(self, volume: TsdfVolume, one: Camera, T_WC: Tensor, far_m: float, half_m: float = 0.3):
        ray_C = rays(one, torch.tensor([0.5, 0.5]))
        z, y = torch.linspace(0, far_m, 450), torch.linspace(-half_m, half_m, 100)
        points_C = z[None, :, None] * ray_C + y[:, None, None] * torch.tensor([0.0, 1.0, 0.0])
        found = volume.sample_nearest(se3.apply(T_WC.float(), points_C).view(-1, 3).to(volume.device))
        D, W = found.D.view(100, 450).cpu().numpy(), found.W.view(100, 450).cpu().numpy()
        ground = np.where(W > 0, 255, 0).astype(np.uint8)[..., None]
        self.image = np.concatenate([distance_colours(D), ground], axis=2)
        self.extent = (0.0, far_m, half_m, -half_m)


def _picture(figure: "Figure", plane: _Plane, steps: list[Step]) -> Callable[[Step], bool]:
    above, below = figure.add_axes((0.12, 0.66, 0.86, 0.28)), figure.add_axes((0.12, 0.13, 0.86, 0.43))
    above.imshow(plane.image, extent=plane.extent, aspect="auto", interpolation="nearest")
    above.axhline(0, color=BETWEEN, linewidth=0.8)
    style(above, title="D in a plane through the ray (red −, blue +)")
    above.set_yticks([])
    style(below, x="depth z, m", y="D")
    below.set_ylim(-1.1, 1.1)
    below.axhline(0, color=BETWEEN, linewidth=0.8)
    orange, red = PALETTE[1], PALETTE[3]
    dots = [moving(axes, "o", color=orange, markersize=4) for axes in (above, below)]
    ahead = [moving(axes, "-", color=orange, linewidth=2) for axes in (above, below)]
    chord = moving(below, "--", color=red, linewidth=1.4)
    now = [moving(axes, "o", color=red, markersize=8, fillstyle="none", mew=2) for axes in (above, below)]
    far = (0.0, plane.extent[1])

    def update(step: Step) -> bool:
        scene, before = step.scene, below.get_xlim()
        z, bracket = scene["z"], scene["bracket"]
        D = 0.0 if bracket else scene["D_met"][-1]
        for k in range(2):
            dots[k].set_data(scene["z_met"], scene["D_met"] if k else [0] * len(scene["z_met"]))
            now[k].set_data([z], [D if k else 0])
            to = [z, scene["next"]] if scene["next"] else []
            ahead[k].set_data(to, [D if k and np.isfinite(D) else 0] * len(to))
        chord.set_data(*((bracket[:2], bracket[2:]) if bracket else ([], [])))
        below.set_xlim(*((bracket[0] - 0.02, bracket[1] + 0.02) if bracket else far))
        return below.get_xlim() != before

    return update
