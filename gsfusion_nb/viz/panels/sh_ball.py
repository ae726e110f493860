"""The colour of a Gaussian from every side: its spherical harmonics painted on balls."""

import math

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ...drawing import pictures
from ...drawing.curves import CARD, CARD_INK, figure_picture
from ...drawing.pictures import Picture, to_uint8
from ...geometry.spherical_harmonics import sh_basis
from .panel import Drawn, Panel, Slider


def sh_ball(sh: Float[Tensor, "K 3"], size: int = 160) -> Picture:
    """The colour of one Gaussian from all sides, painted on a ball: each point has the colour seen
    from that side.

    The ball is seen by a camera that looks along +z, x to the right, y down. A viewer in the
    direction of the normal n looks along d = -n, which is the direction that the harmonics are
    evaluated at.
    """
    n, on_ball = _ball_normals(size)
    degree = round(sh.shape[0] ** 0.5) - 1
    colour = (sh_basis(-n, degree) @ sh + 0.5).clamp(0, 1)
    image = (torch.tensor(pictures.CARD) / 255).repeat(size * size, 1)
    image[on_ball] = colour
    return to_uint8(image.view(size, size, 3))


def basis_atlas(size: int = 104) -> Picture:
    """The 16 basis functions on balls, one row per degree: red where positive, blue where
    negative."""
    from matplotlib.figure import Figure

    n, on_ball = _ball_normals(size)
    Y = sh_basis(-n, 3)
    figure = Figure(figsize=(0.07 * size, 0.04 * size), dpi=100, facecolor=CARD)
    grid = figure.add_gridspec(
        4,
        7,
        left=0,
        right=1,
        bottom=0,
        top=1,
        wspace=0,
        hspace=0,
    )
    for k in range(16):
        degree = math.isqrt(k)
        tile = np.full(size * size, np.nan)
        tile[on_ball] = Y[:, k]
        axes = figure.add_subplot(grid[degree, 3 - degree + k - degree * degree])
        axes.imshow(
            tile.reshape(size, size),
            cmap="bwr",
            vmin=-0.9,
            vmax=0.9,
        )
        axes.set_axis_off()
        axes.text(3, 13, f"Y{k}", color=CARD_INK, fontsize=8)
    return figure_picture(figure)


def _ball_normals(size: int) -> tuple[Tensor, Tensor]:
    """Outward normals of the visible half of a ball, and which pixels of the square show it."""
    i = (torch.arange(size) + 0.5 - size / 2) / (0.44 * size)
    y, x = torch.meshgrid(i, i, indexing="ij")
    on_ball = (x * x + y * y < 1).flatten()
    x = x.flatten()[on_ball]
    y = y.flatten()[on_ball]
    return torch.stack(
        [x, y, -(1 - x * x - y * y).sqrt()],
        -1,
    ), on_ball


_BALL_PX = 280


def sh_ball_panel() -> Panel:
    """One coefficient of one basis function of the colour, painted on a ball (``sh_ball``)."""

    def draw(
        k: int,
        red: float | int,
        green: float | int,
        blue: float | int,
    ) -> Drawn:
        sh = torch.zeros(16, 3)
        sh[k] = torch.tensor([red, green, blue], dtype=torch.float32)
        return sh_ball(sh, _BALL_PX), f"all coefficients are 0 but sh<sub>{k}</sub>"

    controls = {
        "k": Slider(
            value=3,
            low=0,
            high=15,
            step=1,
            label="function k",
        ),
        **{
            name: Slider(
                value=start,
                low=-1.5,
                high=1.5,
                step=0.05,
                label=f"sh_k, {name}",
            )
            for name, start in (("red", 0.6), ("green", 0.0), ("blue", -0.6))
        },
    }
    return Panel(
        draw, controls, name="sh-ball", kind="png", text="A Gaussian's colour from all sides"
    )
