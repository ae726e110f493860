"""How many (Gaussian, tile) pairs the kernels can number, in numba and in CUDA."""

MOST_PAIRS = 1 << 31
"""Kernels number pairs with 32 bits."""


def check_pairs(total: int) -> None:
    """Raise ``ValueError`` if there are more (Gaussian, tile) pairs than kernels can number."""
    if total >= MOST_PAIRS:
        raise ValueError(
            f"render_forward: {total} (Gaussian, tile) pairs are more than 2^31; draw a smaller image, "
            "or a map of smaller Gaussians"
        )
