"""Poses and exposures of keyframes, fitted in the passes after the scan."""

import dataclasses
from collections.abc import Mapping
from math import radians

import torch
from jaxtyping import Float
from torch import Tensor

from ..config import OptimConfig
from ..gaussians import GaussianModel
from ..gaussians.rigid_motion import move_map_
from ..geometry import se3
from ..optim import Keyframe, KeyframeList, Loss, ViewLoss
from ..optim.exposure import apply_exposure, apply_exposure_vjp, fit_exposure
from ..optim.pose_system import pose_step, pose_system
from ..render.constants import SHOWN_ALPHA
from ..types import RenderOutput
from .trajectory import Trajectory, between

LEAST_SHARE = 0.5
"""A view moves only if the map shows at least this share of its pixels."""


class KeyframeFits:
    """What the passes after the scan fit to each keyframe, besides the Gaussians: its exposure and
    its pose.

    Exposures (``optim.fit_exposure``) are stored with the keyframes, so that the map has the mean
    brightness of the pictures.

    With ``optim.refine_poses`` a keyframe moves one step towards the pose at which the map fits it
    whenever it is visited, because the map's picture of it is there anyway. A prior holds each pose
    at that of the data. After each pass, the mean motion of all keyframes is taken back, by moving
    map and keyframes together, so that the map stays where the data puts it; and the frames between
    keyframes follow them. The poses are the trajectory's and the keyframes'.
    """

    def __init__(self, optim: OptimConfig, trajectory: Trajectory):
        self._optim = optim
        self._trajectory = trajectory
        sigma = [optim.pose_sigma_m] * 3 + [radians(optim.pose_sigma_deg)] * 3
        self._sigma = torch.tensor(sigma, dtype=torch.float64)
        self._picture: RenderOutput | None = None
        """The map's picture of the keyframe that is visited, with its exposure."""

    def exposed_loss(
        self,
        loss: Loss,
        keyframes: KeyframeList,
        keyframe: Keyframe,
        target_rgb: Float[Tensor, "H W 3"],
    ) -> Loss:
        """``loss`` of the map's picture with the exposure of the keyframe, whose image is
        ``target_rgb``; the exposure of its next visit is fitted to the map of now."""

        def of_picture(output: RenderOutput) -> tuple[ViewLoss, Tensor | None]:
            if not self._optim.fit_exposure:
                self._picture = output
                return loss(output)
            fitted_exposure = fit_exposure(output.rgb, target_rgb, output.alpha >= SHOWN_ALPHA)
            keyframes.set_exposure(keyframe.index, fitted_exposure)
            exposure = (
                fitted_exposure
                if keyframe.exposure is None
                else keyframe.exposure.to(fitted_exposure)
            )
            self._picture = dataclasses.replace(output, rgb=apply_exposure(output.rgb, exposure))
            view_loss, mse = loss(self._picture)
            v_rgb, _ = apply_exposure_vjp(output.rgb, exposure, view_loss.v_rgb)
            return dataclasses.replace(view_loss, v_rgb=v_rgb), mse

        return of_picture

    def move(
        self, keyframes: KeyframeList, keyframe: Keyframe, target_rgb: Float[Tensor, "H W 3"]
    ) -> None:
        """Move a keyframe, whose image is ``target_rgb``, one step, by the map's picture of it that
        its last gradient was computed from."""
        picture = self._picture
        self._picture = None
        if not self._optim.refine_poses or picture is None:
            return
        row = self._trajectory.frame_indices.index(keyframe.index)
        system = pose_system(picture, target_rgb, keyframe.camera)
        if system.share >= LEAST_SHARE:
            T_WC = pose_step(system, keyframe.T_WC, self._trajectory.given_poses[row], self._sigma)
            keyframes.set_pose(keyframe.index, T_WC)
            self._trajectory.refine(row, T_WC.cpu())

    def end_pass(self, keyframes: KeyframeList, gaussians: GaussianModel) -> None:
        """Take back what all keyframes share: it belongs to the map, and no picture can tell it."""
        if self._optim.refine_poses:
            self._take_back_motion(keyframes, gaussians)
        log_exposures = {k.index: k.exposure.log() for k in keyframes if k.exposure is not None}
        if log_exposures:  # a factor that all share is the map's brightness
            mean = torch.stack(list(log_exposures.values())).mean(0)
            for index, log_exposure in log_exposures.items():
                keyframes.set_exposure(index, (log_exposure - mean).exp())

    def _take_back_motion(self, keyframes: KeyframeList, gaussians: GaussianModel) -> None:
        """Where all keyframes move together by G, T_i = G T_i(given), the pictures do not change:
        nothing holds G."""
        poses = self._trajectory.poses
        given_poses = self._trajectory.given_poses
        rows = sorted(self._trajectory.frame_indices.index(k.index) for k in keyframes)
        T_WC, T_given = (torch.stack([p[r] for r in rows]).double() for p in (poses, given_poses))
        T_back = se3.exp(-se3.log(T_WC @ se3.inverse(T_given)).mean(0))
        gaussians.undo_log.will_change()
        T = T_back.to(gaussians.device, torch.float32)
        move_map_(gaussians, T.expand(len(gaussians), 4, 4))
        for keyframe in list(keyframes):
            row = self._trajectory.frame_indices.index(keyframe.index)
            T_new = (T_back @ poses[row].double()).float()
            keyframes.set_pose(keyframe.index, T_new)
            self._trajectory.refine(row, T_new)
        self._trajectory.follow(rows)


def exposure_between(
    fitted: Mapping[int, Float[Tensor, " 3"]],
    index: int,
) -> Float[Tensor, " 3"]:
    """The exposure of any frame of the source by those of the frames before and after it,
    interpolated in stops.

    Args:
        fitted: Number of a frame -> its exposure; at least one.
        index: Number of the frame; its own picture is not used.
    """
    indices = sorted(fitted)
    stops = torch.stack([fitted[i].double().log2().cpu() for i in indices])
    return between(torch.tensor(indices), stops, index).exp2().float()
