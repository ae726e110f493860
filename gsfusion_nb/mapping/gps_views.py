"""The views that GPS-SLAM optimises, each with the picture of the surface below its Gaussians."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from ..config import BaseConfig, ScheduleConfig
from ..optim import Keyframe, KeyframeList, PictureVjp
from ..render import (
    OverBaseOutput,
    SurfacePicture,
    render_over_base,
    render_over_base_vjp,
    surface_picture,
)
from ..render.constants import NEAR_PLANE_M
from ..tsdf import TsdfVolume, raycast
from ..types import Camera, GaussianParams
from .transaction import Undo

WINDOW = 2
"""How many of the last frames are among the views."""

WINDOW_TURNS = 2 / 7
"""Turns of the latest frames for each turn of a keyframe, as with the 2 frames and 7 keyframes of
the release."""

PASS_VIEWS_BYTES = 256 << 20
"""Memory for the surfaces that the passes after the scan have seen; the others are looked at anew
in each pass."""

LOOK_STEPS = 1.5
SEEDING_STEPS = 2.0
"""Gradient steps that take as long as a look at the TSDF, and as seeding; measured at 320 x 240."""


@dataclass(frozen=True, kw_only=True, eq=False)
class SurfaceKeyframe:
    """A view to optimise, and what its camera saw of the surface when it was last looked at."""

    keyframe: Keyframe
    surface_rgb: Float[Tensor, "h w 3"]
    """Raycast colours, from which ``surface`` was made."""
    surface_depth_m: Float[Tensor, "h w"]
    surface: SurfacePicture

    @staticmethod
    def of(
        keyframe: Keyframe, rgb: Tensor, depth_m: Tensor, config: BaseConfig
    ) -> "SurfaceKeyframe":
        """A view whose camera sees these colours and depths of the surface."""
        camera = keyframe.camera
        size = (camera.height, camera.width)
        return SurfaceKeyframe(
            keyframe=keyframe,
            surface_rgb=rgb,
            surface_depth_m=depth_m,
            surface=surface_picture(rgb, depth_m, size, config.holes, config.behind_m),
        )

    def render(
        self, params: GaussianParams, near_m: float = NEAR_PLANE_M
    ) -> tuple[OverBaseOutput, PictureVjp]:
        """Surface and Gaussians beyond ``near_m``, and the gradient of the Gaussians; the surface
        is held fixed."""
        view = self.keyframe
        output, saved = render_over_base(
            params,
            view.camera,
            view.T_WC,
            self.surface.base,
            behind_m=self.surface.behind_m,
            near_m=near_m,
        )
        return output, lambda v_rgb, *_, **outputs: render_over_base_vjp(saved, v_rgb, **outputs)

    def state_dict(self) -> dict[str, Any]:
        """Plain values."""
        return {
            "keyframe": self.keyframe.state_dict(),
            "seen_rgb": self.surface_rgb,
            "seen_depth_m": self.surface_depth_m,
        }

    @property
    def n_bytes(self) -> int:
        """Memory of what was seen."""
        images = (*vars(self.surface.base).values(), self.surface_rgb, self.surface_depth_m)
        return sum(image.nbytes for image in images)


def look_at(
    volume: TsdfVolume, keyframe: Keyframe, config: BaseConfig, *, full: bool = False
) -> SurfaceKeyframe:
    """The view with what its camera sees of the volume now.

    Args:
        volume: The surface.
        keyframe: The view.
        config: Size of the raycast, and what to do about holes.
        full: Cast a ray for every pixel, whatever ``config.resolution`` says.
    """
    camera = keyframe.camera if full else small(keyframe.camera, config)
    surface = raycast(volume, camera, keyframe.T_WC)
    return SurfaceKeyframe.of(keyframe, surface.rgb, surface.depth_m, config)


def small(camera: Camera, config: BaseConfig) -> Camera:
    """The camera that rays are cast for while mapping; of odd sizes, the small picture covers a
    pixel more."""
    if config.resolution == "full":
        return camera
    width = (camera.width + 1) // 2
    height = (camera.height + 1) // 2
    lens = {"fx": camera.fx, "fy": camera.fy, "cx": camera.cx, "cy": camera.cy}
    return replace(camera.resized(2 * width, 2 * height), **lens).resized(width, height)


class ViewRound:
    """The views of a round: the latest frames and some random keyframes, which take turns.

    A keyframe that is looked at takes its own place, or that of the one that was looked at longest
    ago when there are enough. Steps draw from all views without replacement; when all had their
    turn, a new order is drawn.
    """

    def __init__(self, config: ScheduleConfig):
        self.config = config
        self.window: list[SurfaceKeyframe] = []
        """The latest frames, oldest first."""
        self.recalls: list[SurfaceKeyframe] = []
        """Random keyframes, in the order in which they were looked at."""
        self._turns: list[int] = []
        self._steps = _even_steps(config)

    def __len__(self) -> int:
        return len(self.window) + len(self.recalls)

    def renew(
        self,
        n_frames: int,
        newest: SurfaceKeyframe | None,
        keyframes: KeyframeList,
        look: Callable[[Keyframe], SurfaceKeyframe],
        generator: torch.Generator,
    ) -> None:
        """Look again at the views whose turn it is.

        Args:
            n_frames: Number of frames that were mapped before this one.
            newest: This frame, if it becomes one of the views.
            keyframes: The keyframes of the map.
            look: Looks at the surface.
            generator: Keyframes are drawn from it.
        """
        if newest is not None and bool((newest.surface_depth_m > 0).any()):
            self.window = [*self.window, newest][-WINDOW:]
        if not self.config.spread and self.steps_in(n_frames):
            self.look_again(look)
        n = self._share(self.config.recalled, n_frames)
        n_new = min(n, self._share(self.config.recalled_new, n_frames))
        self.recall(keyframes, look, generator, n, n_new)

    def recall(
        self,
        keyframes: KeyframeList,
        look: Callable[[Keyframe], SurfaceKeyframe],
        generator: Any,
        n: int,
        n_new: int,
    ) -> None:
        """Look at ``n`` keyframes, of which up to ``n_new`` were never looked at, the newest but
        one; others at random.

        The newest is not looked at: the surface is one frame older than it, so half of its picture
        may be missing.
        """
        new = [keyframes[len(keyframes) - 2]] if n_new and len(keyframes) > 1 else []
        looked_at = max((view.keyframe.index for view in self.recalls), default=-1)
        new = [keyframe for keyframe in new if keyframe.index > looked_at][: self.config.keyframes]
        for keyframe in [
            *new,
            *keyframes.draw(min(n, self.config.keyframes) - len(new), generator),
        ]:
            others = [view for view in self.recalls if view.keyframe.index != keyframe.index]
            self.recalls = [*others, look(keyframe)][-self.config.keyframes :]

    def look_again(self, look: Callable[[Keyframe], SurfaceKeyframe]) -> None:
        """Look at the frames of the window again."""
        self.window = [look(view.keyframe) for view in self.window]

    def steps_in(self, n_frames: int) -> int:
        """Gradient steps in the frame before which ``n_frames`` were mapped; fewer where other work
        is done."""
        if not self.config.spread:
            return self._share(self.config.iterations, n_frames)
        return self._steps[n_frames % self.config.every_frames]

    def _share(self, in_round: int, n_frames: int) -> int:
        """What the frame before which ``n_frames`` were mapped does of what is done in a round."""
        position = n_frames % self.config.every_frames
        if not self.config.spread:
            return in_round if n_frames and position == 0 else 0
        return _even_share(in_round, position, self.config.every_frames)

    @property
    def _turns_of_window(self) -> int:
        """Turns of the frames of the window among those of all keyframes: of each at least one."""
        return WINDOW * max(1, round(WINDOW_TURNS * self.config.keyframes / WINDOW))

    def next_view(self, generator: torch.Generator) -> SurfaceKeyframe:
        """The view whose turn it is; there must be one."""
        while True:
            if not self._turns:
                self._turns = torch.randperm(
                    self._turns_of_window + self.config.keyframes, generator=generator
                ).tolist()
            turn = self._turns.pop(0)
            kind = self.window
            position = turn % WINDOW
            if turn >= self._turns_of_window:
                kind = self.recalls
                position = turn - self._turns_of_window
            if position < len(kind):
                return kind[position]

    def forget(self) -> None:
        """Leave out all views, because their poses have changed."""
        self.window = []
        self.recalls = []

    def undo_log(self) -> Undo:
        """A function that brings back the views and turns of now."""
        window = self.window
        recalls = self.recalls
        turns = list(self._turns)

        def undo() -> None:
            self.window = window
            self.recalls = recalls
            self._turns = list(turns)

        return undo

    def constant_tensors(self) -> list[Tensor]:
        """Those in ``state_dict``: none of them changes."""
        views = [*self.window, *self.recalls]
        return [
            x
            for view in views
            for x in (
                view.keyframe.rgb_u8,
                view.surface_rgb,
                view.surface_depth_m,
                *view.keyframe.extra.values(),
            )
        ]

    def state_dict(self) -> dict[str, Any]:
        """Views and turns."""
        views = {"window": self.window, "recalled": self.recalls}
        return {name: [v.state_dict() for v in kind] for name, kind in views.items()} | {
            "turns": list(self._turns)
        }

    def load_state_dict(
        self, state: dict[str, Any], base: BaseConfig, device: torch.device
    ) -> None:
        """Restore what ``state_dict`` saved."""
        self.window = _views_of_state(state["window"], base, device)
        self.recalls = _views_of_state(state["recalled"], base, device)
        self._turns = list(state["turns"])


def _views_of_state(
    states: list[dict[str, Any]], base: BaseConfig, device: torch.device
) -> list[SurfaceKeyframe]:
    keyframes = KeyframeList.from_state_dict([state["keyframe"] for state in states], device)
    return [
        SurfaceKeyframe.of(
            keyframe, state["seen_rgb"].to(device), state["seen_depth_m"].to(device), base
        )
        for keyframe, state in zip(keyframes, states, strict=True)
    ]


class PassViews:
    """The views of the passes after the scan, of which the first are kept."""

    def __init__(self) -> None:
        self._views: dict[int, SurfaceKeyframe] = {}

    def of(self, i: int, look: Callable[[], SurfaceKeyframe]) -> SurfaceKeyframe:
        """The view of the i-th keyframe; ``look`` makes it."""
        if i in self._views:
            return self._views[i]
        view = look()
        if (len(self._views) + 1) * view.n_bytes <= PASS_VIEWS_BYTES:
            self._views[i] = view
        return view


def _even_share(in_round: int, position: int, every: int) -> int:
    """What the frame at ``position`` does of what is spread evenly over the ``every`` frames of a
    round."""
    return in_round * (position + 1) // every - in_round * position // every


def _even_steps(config: ScheduleConfig) -> list[int]:
    """Steps of each frame of a round: each step is given to the frame with the least work.

    The first frame also seeds. The TSDF is looked at there, at the frames of the window and at
    recalled keyframes.
    """
    every = config.every_frames
    looks = [
        (k % config.window_every == 0) + _even_share(config.recalled, k, every)
        for k in range(every)
    ]
    work = [LOOK_STEPS * n for n in looks]
    work[0] += SEEDING_STEPS
    steps = [0] * every
    for _ in range(config.iterations):
        position = work.index(min(work))
        work[position] += 1
        steps[position] += 1
    return steps
