"""A splat: a Gaussian on the screen as a row of 12 float32, the same for numba and CUDA (``splat.cuh``)."""

COLUMNS = U, V, CONIC_A, CONIC_B, CONIC_C, LN_OPACITY, RED, GREEN, BLUE, DEPTH, EXTENT_U, EXTENT_V = range(12)
"""Centre, pixels; inverse covariance, sigma = (A dx^2 + C dy^2) / 2 + B dx dy; ln(opacity); colour; z, metres; half the
width and half the height of the ellipse alpha >= 1/255, pixels."""

SPLAT = 12
"""Numbers in a row."""
