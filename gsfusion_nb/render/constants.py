"""Numbers shared by the reference and the fast kernels, each with its reason."""

import math

NEAR_PLANE_M = 0.2
"""Gaussians closer to the camera than this are not drawn (Kerbl et al. 2023, released
rasteriser)."""

FARTHEST_PX = 1e9
"""A Gaussian whose centre or half size on the screen is not below this, or is NaN, is not drawn:
kernels count pixels in whole numbers, and a map with a NaN or an infinity in it looks the same on
every backend."""

SCREEN_BLUR_PX2 = 0.3
"""Added to the diagonal of every 2D covariance so that no splat is thinner than about a pixel (EWA
low-pass)."""

FRUSTUM_CLAMP = 1.3
"""x/z and y/z are clamped to this many half fields of view in the projection Jacobian, which is
wrong beyond."""

ALPHA_MAX = 0.99
"""Upper clamp on a splat's alpha: keeps 1 - alpha away from zero, which the gradient divides by."""

ALPHA_MIN = 1.0 / 255.0
"""A splat fainter than one grey level at a pixel is skipped there."""

TRANSMITTANCE_MIN = 1e-4
"""A pixel is finished before the splat that would bring its transmittance below this."""

OPAQUE_ALPHA = math.exp(-0.5)
"""A disc is hit where its alpha reaches this: an opaque Gaussian's value at one standard deviation
(Peng et al. 2024, section 3.1; the released code has 0.6)."""

DISC_MIN_COSINE = 0.5
"""Discs at more than 60 degrees from the ray are not intersected: there a small error of the normal
moves the intersection far (Peng et al. 2024, eq. 5)."""

DISC_MAX_OFFSET = 1.0
"""Farther from the centre than this many of the disc's largest standard deviations, counted along
z, the intersection lies off the disc (released code of Peng et al. 2024; not in the paper)."""

TILE_PX = 8
"""Edge of a screen tile of the reference, pixels. The picture does not depend on it: 16 evaluates
twice as many (pixel, Gaussian) pairs, 4 makes 2.5 times as many list entries."""

SHOWN_ALPHA = 0.5
"""The map shows a pixel if its accumulated opacity is at least this."""
