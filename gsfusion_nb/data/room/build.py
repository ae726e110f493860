"""Short constructors of painted solids, and placing a piece of furniture."""

import dataclasses
from collections.abc import Sequence

import numpy as np
from numpy import ndarray

from .solids import Box, Ellipsoid, Frustum, Paint, Solid, rotation
from .textures import Colour, Draw

Size = Sequence[int | float] | ndarray


def plain(*colour: int | float, gloss: float = 0.0, texel_m: float = 0.02) -> Paint:
    """One colour."""
    r, g, b = colour
    return Paint(colour=(r, g, b), texel_m=texel_m, gloss=gloss)


def drawn(draw: Draw, texel_m: float, gloss: float = 0.0) -> Paint:
    """A drawn texture."""
    return Paint(draw=draw, texel_m=texel_m, gloss=gloss)


def _paints(faces: Sequence[str], paint: Paint, hide: str, special: dict[str, Paint] | None) -> dict[str, Paint]:
    hidden = hide.split()
    return {f: (special or {}).get(f, paint) for f in faces if f not in hidden}


def box(
    centre: Size,
    size: Size,
    paint: Paint,
    *,
    radius: float = 0.0,
    turn: Size = (0, 0, 0),
    hide: str = "",
    special: dict[str, Paint] | None = None,
) -> Box:
    """A box of full ``size``; faces named in ``hide`` can never be seen; ``special`` paints single faces."""
    return Box(
        t=np.array(centre, float),
        R=rotation(*turn),
        half=0.5 * np.array(size, float),
        radius=radius,
        paints=_paints(Box.faces, paint, hide, special),  # pyright: ignore[reportArgumentType]
    )


def cone(
    base: Size,
    height: float,
    radii: Size,
    paint: Paint,
    *,
    turn: Size = (0, 0, 0),
    hide: str = "",
    special: dict[str, Paint] | None = None,
) -> Frustum:
    """A capped cone standing on ``base``: ``radii`` at the bottom and at the top."""
    R = rotation(*turn)
    return Frustum(
        t=np.array(base, float) + R[:, 2] * (0.5 * height),
        R=R,
        half_height=0.5 * height,
        r_bottom=radii[0],
        r_top=radii[1],
        paints=_paints(Frustum.faces, paint, hide, special),  # pyright: ignore[reportArgumentType]
    )


def rod(p: Size, q: Size, radius: float, paint: Paint, hide: str = "") -> Frustum:
    """A cylinder from ``p`` to ``q``."""
    start, end = np.array(p, float), np.array(q, float)
    length = float(np.linalg.norm(end - start))
    z = (end - start) / length
    x = np.cross([0.0, 1.0, 0.0] if abs(z[1]) < 0.9 else [1.0, 0.0, 0.0], z)
    x /= np.linalg.norm(x)
    return Frustum(
        t=0.5 * (start + end),
        R=np.stack([x, np.cross(z, x), z], 1),
        half_height=0.5 * length,
        r_bottom=radius,
        r_top=radius,
        paints=_paints(Frustum.faces, paint, hide, None),  # pyright: ignore[reportArgumentType]
    )


def ball(centre: Size, semi: float | Size, paint: Paint, *, turn: Size = (0, 0, 0)) -> Ellipsoid:
    """A sphere, or an ellipsoid with three semi-axes."""
    axes = np.full(3, semi) if isinstance(semi, (int, float)) else np.array(semi, float)
    return Ellipsoid(t=np.array(centre, float), R=rotation(*turn), semi=axes, paints={"skin": paint})


def placed(solids: Sequence[Solid], at: Size, yaw_deg: int | float = 0.0) -> list[Solid]:
    """A piece of furniture rotated about z and moved; without rotation its front faces -y."""
    R, t = rotation(yaw_deg), np.array(at, float)
    return [dataclasses.replace(s, R=R @ s.R, t=R @ s.t + t) for s in solids]


def glowing(colour: Colour, brightness: float, draw: Draw | None = None, texel_m: float = 0.02) -> Paint:
    """A surface that emits light."""
    return Paint(draw=draw, colour=colour, glow=brightness, texel_m=texel_m)
