"""Short constructors of solids with paint on their faces."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy import ndarray

from .solids import Box, Ellipsoid, Frustum, Paint, Solid, Vector, rotation


def plain(
    *colour: int | float,
    texel_m: float = 0.02,
    glow: float = 0.0,
) -> Paint:
    """One colour."""
    r, g, b = colour
    return Paint(colour=(r, g, b), texel_m=texel_m, glow=glow)


def drawn(
    texel_m: float, draw: Callable[..., ndarray], *options, glow: float = 0.0, **more
) -> Paint:
    """A texture ``draw(width_px, height_px, texel_m, rng, *options)``, one of ``drawings``."""
    return Paint(
        draw=lambda *size: draw(*size, *options, **more),
        texel_m=texel_m,
        glow=glow,
    )


def _painted(
    kind: type[Solid],
    paint: Paint,
    hide: str = "",
    special: Mapping[str, Paint] | None = None,
    **shape,
) -> Solid:
    """A solid with ``paint`` on its faces, except those that ``special`` paints, and those in
    ``hide``: never seen."""
    faces: Any = kind.faces
    return kind(
        paints={f: (special or {}).get(f, paint) for f in faces if f not in hide.split()},
        **shape,
    )


def box(
    centre: Vector,
    size: Vector,
    paint: Paint,
    *,
    radius: float = 0.0,
    turn: Vector = (0, 0, 0),
    **more,
) -> Solid:
    """A box of full ``size``; for ``more`` see ``_painted``."""
    half = 0.5 * np.array(size, float)
    return _painted(
        Box,
        paint,
        t=np.array(centre, float),
        R=rotation(*turn),
        half=half,
        radius=radius,
        **more,
    )


def cone(
    base: Vector,
    height: float,
    radii: Vector,
    paint: Paint,
    *,
    turn: Vector = (0, 0, 0),
    **more,
) -> Solid:
    """A capped cone standing on ``base``: ``radii`` at the bottom and at the top."""
    R = rotation(*turn)
    half = 0.5 * height
    t = np.array(base, float) + R[:, 2] * (0.5 * height)
    return _painted(
        Frustum,
        paint,
        t=t,
        R=R,
        half_height=half,
        r_bottom=radii[0],
        r_top=radii[1],
        **more,
    )


def rod(
    p: Vector,
    q: Vector,
    radius: float,
    paint: Paint,
    hide: str = "",
) -> Solid:
    """A cylinder from ``p`` to ``q``."""
    start = np.array(p, float)
    end = np.array(q, float)
    length = float(np.linalg.norm(end - start))
    z = (end - start) / length
    x = np.cross(
        [0.0, 1.0, 0.0] if abs(z[1]) < 0.9 else [1.0, 0.0, 0.0],
        z,
    )
    x /= np.linalg.norm(x)
    t = 0.5 * (start + end)
    R = np.stack([x, np.cross(z, x), z], 1)
    half = 0.5 * length
    return _painted(
        Frustum,
        paint,
        hide,
        t=t,
        R=R,
        half_height=half,
        r_bottom=radius,
        r_top=radius,
    )


def ball(
    centre: Vector,
    semi: float | Vector,
    paint: Paint,
    *,
    turn: Vector = (0, 0, 0),
    **more,
) -> Solid:
    """A sphere, or an ellipsoid with three semi-axes."""
    axes = np.full(3, semi) if isinstance(semi, (int, float)) else np.array(semi, float)
    return _painted(
        Ellipsoid,
        paint,
        t=np.array(centre, float),
        R=rotation(*turn),
        semi=axes,
        **more,
    )


def placed(
    solids: Sequence[Solid],
    at: Vector,
    yaw_deg: int | float = 0.0,
) -> list[Solid]:
    """A piece of furniture rotated about z and moved; without rotation its front faces -y."""
    R = rotation(yaw_deg)
    t = np.array(at, float)
    return [
        replace(
            s,
            R=R @ s.R,
            t=R @ s.t + t,
        )
        for s in solids
    ]
