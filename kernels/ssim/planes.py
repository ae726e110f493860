"""Order of the pictures that the kernels keep between their passes, shared by numba and Triton."""

X, Y, XX, YY, XY = range(5)
"""Window averages: of both pictures, of their squares and of their product."""
N_MEANS = 5

BY_MEAN, BY_SQUARE, BY_PRODUCT = range(3)
"""Derivatives of SSIM by the averages of x, x^2 and x y; later the window averages of these."""
N_TERMS = 3
