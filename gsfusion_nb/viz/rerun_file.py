"""A run as a file for the Rerun viewer: frames, poses, the growing maps and the scores, over time.

Needs the extra ``rerun``. The viewer opens the file: ``rerun FILE.rrd``. Times: ``frame`` counts mapped frames,
``recorded`` is the recording's own time.
"""

import math
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ..drawing.pictures import encode_jpeg, to_uint8
from ..geometry import quaternion
from ..geometry.upright import world_up
from ..mapping import Mapper, StepReport
from ..types import Camera, Frame, GaussianParams, Mesh
from .splat_rows import finite_rows

_UP = {(0, 0, 1): "RIGHT_HAND_Z_UP", (0, 1, 0): "RIGHT_HAND_Y_UP", (0, -1, 0): "RIGHT_HAND_Y_DOWN"}
_DEPTH_STEPS_PER_M = 1000.0


class RerunFile:
    """Watches a run (``run_mapping(..., watch=RerunFile("run.rrd"))``) and writes what happens to an ``.rrd`` file.

    Args:
        path: File to write; one that exists is replaced.
        maps_every: Gaussians and mesh are written after every n-th mapped frame, and at the end.

    Raises:
        ValueError: the package rerun-sdk is not installed, or ``path`` does not end in .rrd.
    """

    def __init__(self, path: str | Path, *, maps_every: int = 20):
        try:
            import rerun
        except ImportError:
            raise ValueError("writing .rrd files needs the extra rerun: pip install 'gsfusion-nb[rerun]'") from None
        self.path = Path(path)
        if self.path.suffix != ".rrd":
            raise ValueError(f"{path} must end in .rrd, which the Rerun viewer opens")
        self.path.parent.mkdir(parents=True, exist_ok=True)
        self.maps_every = maps_every
        self._rr = rerun
        self._centres: list[list[float]] = []
        self._to = rerun.RecordingStream("gsfusion_nb")
        self._to.save(self.path)

    def frame_mapped(self, mapper: Mapper, frame: Frame, report: StepReport) -> None:
        """Write the frame, its pose and its scores; every ``maps_every`` frames also the maps."""
        rr, T_WC = self._rr, mapper.localiser.poses[-1]
        if not self._centres:  # of a run that is continued, the path so far
            self._centres = [pose[:3, 3].tolist() for pose in mapper.localiser.poses[:-1]]
            up = tuple(world_up([T_WC]).int().tolist())
            self._to.log("world", getattr(rr.ViewCoordinates, _UP.get(up, "RIGHT_HAND_Z_UP")), static=True)
        self._to.set_time("frame", sequence=mapper.n_frames)
        self._to.set_time("recorded", duration=frame.timestamp_s)
        self._camera(frame.camera, T_WC.cpu().double().numpy())
        self._to.log(
            "world/camera/colour",
            rr.EncodedImage(contents=encode_jpeg(frame.rgb_u8.cpu().numpy()), media_type="image/jpeg"),
        )
        depth = (frame.depth_m.cpu() * _DEPTH_STEPS_PER_M).round().clamp(0, 65535).numpy().astype(np.uint16)
        self._to.log("world/camera/depth", rr.DepthImage(depth, meter=_DEPTH_STEPS_PER_M))
        for name, value in _scores(report).items():
            self._to.log(f"scores/{name}", rr.Scalars(value))
        if mapper.n_frames % self.maps_every == 0:
            self._maps(mapper, mapper.mesh())

    def finished(self, mapper: Mapper, mesh: Mesh, metrics: dict[str, Any]) -> None:
        """Write the final maps and scores, and close the file."""
        self._to.set_time("frame", sequence=mapper.n_frames + 1)
        self._maps(mapper, mesh)
        for name, value in metrics.items():
            if name.startswith(("psnr_", "ssim_", "mesh_", "ate_")) and isinstance(value, int | float):
                self._to.log(f"final/{name}", self._rr.Scalars(float(value)))
        self._to.flush()
        self._to.disconnect()

    def _camera(self, camera: Camera, T_WC: np.ndarray) -> None:
        rr = self._rr
        self._to.log("world/camera", rr.Transform3D(translation=T_WC[:3, 3], mat3x3=T_WC[:3, :3]))
        pinhole = rr.Pinhole(
            focal_length=(camera.fx, camera.fy), principal_point=(camera.cx, camera.cy),
            width=camera.width, height=camera.height, camera_xyz=rr.ViewCoordinates.RDF,
        )  # fmt: skip
        self._to.log("world/camera", pinhole)
        self._centres.append(T_WC[:3, 3].tolist())
        self._to.log("world/path", rr.LineStrips3D([self._centres]))

    def _maps(self, mapper: Mapper, mesh: Mesh) -> None:
        self._to.log("world/gaussians", _splats(self._rr, mapper.gaussians.params))
        if len(mesh.faces):
            triangles = self._rr.Mesh3D(
                vertex_positions=mesh.vertices_W.cpu().numpy(), triangle_indices=mesh.faces.cpu().numpy(),
                vertex_colors=to_uint8(mesh.rgb[None])[0],
            )  # fmt: skip
            self._to.log("world/mesh", triangles)


def _scores(report: StepReport) -> dict[str, float]:
    """Those of a frame; without those that were not measured, which leaves a gap in their curve."""
    scores = {
        "psnr_before_db": report.psnr_before_db,
        "psnr_after_db": report.psnr_after_db,
        "gaussians": float(report.n_gaussians),
        "seeds": float(report.n_seeds),
        "seconds": report.total_seconds,
    }
    return {name: value for name, value in scores.items() if not math.isnan(value)}


def _splats(rr: Any, params: GaussianParams) -> Any:
    """Gaussians with natural values: standard deviations, opacities, colours of the constant coefficient."""
    from ..geometry.spherical_harmonics import SH_C0

    params = params[finite_rows(params)]
    rgb = (params.sh[:, 0] * SH_C0 + 0.5).clamp(0, 1)
    rgba = (torch.cat([rgb, params.opacity_logit.sigmoid()[:, None]], dim=1) * 255).round().to("cpu", torch.uint8)
    K = params.sh.shape[1] - 1
    return rr.GaussianSplats3D(
        params.xyz_W.cpu().numpy(),
        scales=params.log_scale.exp().cpu().numpy(),
        quaternions=quaternion.normalise(params.quat)[:, [1, 2, 3, 0]].cpu().numpy(),
        colors=rgba.numpy(),
        sh_coefficients=torch.nn.functional.pad(params.sh[:, 1:], (0, 0, 0, 15 - K)).cpu().numpy() if K else None,
        spherical_harmonics_degree=params.sh_degree,
    )
