"""What the gradient of compositing leaves of a splat for the gradient of projection: a row of ten float32.

Per (tile, splat) in the numba kernels, per splat in CUDA (``project/splat.cuh``): sums over pixels of g dx, g dy,
g dx^2, g dx dy, g dy^2 and g, with g = alpha dL/dalpha and (dx, dy) from the centre, and of the weight times dL/d of
colour and depth.
"""

SUM_GX, SUM_GY, SUM_GXX, SUM_GXY, SUM_GYY, SUM_G, SUM_RED, SUM_GREEN, SUM_BLUE, SUM_DEPTH = range(10)

PAIR_SUMS = 10
"""Numbers in a row."""
