"""The fixed schedule of gradient steps that makes rules comparable: no setting in it depends on what a rule seeds."""

import dataclasses
import math
from typing import Any

from ..config import SystemConfig
from .setting_names import flat_settings, with_settings

EQUAL_KEYFRAME_EVERY = 4
"""Every n-th mapped frame is a keyframe where the settings do not say otherwise; MonoGS takes as many on Replica."""
SCHEDULE = frozenset({
    "keyframe_every", "keyframe_min_seeds", "keep_all_frames", "optim.keyframe_iterations", "optim.frame_iterations",
    "optim.random_keyframe_iterations", "optim.global_iterations", "window.iterations", "window.every_frames",
    "window.frames", "keyframes.iterations", "keyframes.rotation_deg", "keyframes.translation_m", "keyframes.latest",
    "keyframes.random", "keyframes.instead_of_window", "final.passes",
})  # fmt: skip
"""Settings of any system that decide how many gradient steps are taken when. No rule may bring its own."""
_PER_FRAME = ("optim.keyframe_iterations", "optim.frame_iterations", "optim.random_keyframe_iterations")


def fixed_schedule(config: SystemConfig) -> SystemConfig:
    """``config`` with keyframes that do not depend on seeds, and a schedule that no rule replaces by its own.

    RTG-SLAM's keyframes follow from the poses already.
    """
    known = flat_settings(config)
    own = sorted(SCHEDULE & set(known) - set(config.seeding.own_settings))
    changes: dict[str, Any] = {"seeding.own_settings": [*config.seeding.own_settings, *own]}
    if known.get("keyframe_every") == 0:
        changes["keyframe_every"] = EQUAL_KEYFRAME_EVERY
    return with_settings(config, changes)


def with_steps_per_frame(config: SystemConfig, steps: int) -> SystemConfig:
    """``config`` with this many gradient steps after each frame, divided between the frame and earlier keyframes as in
    ``config``.

    Raises:
        ValueError: the system takes no steps per frame (RTG-SLAM optimises once per several frames).
    """
    known = flat_settings(config)
    if not set(_PER_FRAME) <= set(known):
        window = known.get("window.iterations")
        if window is None:
            raise ValueError(f"the gradient steps of {type(config).__name__} cannot be set by a budget of seconds")
        return with_settings(config, {"window.iterations": steps})
    _, own, random = (known[name] for name in _PER_FRAME)
    on_random = math.floor(steps * random / max(own + random, 1))
    return with_settings(config, dict(zip(_PER_FRAME, (steps, steps - on_random, on_random), strict=True)))


def dotted(name: str) -> str:
    """``optim__lr_xyz`` as ``optim.lr_xyz``."""
    return name.replace("__", ".")


def steps_per_frame(config: SystemConfig) -> int:
    """Gradient steps after a frame, as ``with_steps_per_frame`` sets them."""
    known = flat_settings(config)
    return known.get("window.iterations", known.get("optim.keyframe_iterations", 0))


def without_steps(config: SystemConfig) -> SystemConfig:
    """``config`` without any gradient step: only seeding and fusion."""
    known = {f.name for f in dataclasses.fields(config)}
    none: dict[str, Any] = dict.fromkeys((*_PER_FRAME, "optim.global_iterations"), 0) if "optim" in known else {}
    return with_settings(config, none)
