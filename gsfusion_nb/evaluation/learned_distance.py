"""LPIPS: the distance of two images in the features of a trained network."""

import functools
import warnings
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from .image import both_on_8bit_grid
from .metrics import NotComputed


def lpips(
    rgb: Float[Tensor, "H W 3"],
    reference: Float[Tensor, "H W 3"],
) -> float | NotComputed:
    """Learned perceptual distance with AlexNet features; 0 for equal images, lower is better.

    Images are given to the network as RGB in -1..1, as it was trained.

    Returns:
        The distance, or the reason why there is none: the optional package ``lpips`` or AlexNet's
        weights are missing. Nothing is downloaded.

    Differentiable: no. Source: Zhang et al. 2018, linear weights of release 0.1.
    """
    a, b = both_on_8bit_grid(rgb, reference)
    return _network_distance(a * 2 - 1, b * 2 - 1)


def lpips_as_released(
    rgb: Float[Tensor, "H W 3"], reference: Float[Tensor, "H W 3"]
) -> float | NotComputed:
    """LPIPS as in GSFusion's published tables: the same network, given BGR in 0..1 instead of RGB
    in -1..1.

    The released evaluation reads images with OpenCV, which gives BGR, and leaves them in 0..1,
    where the network expects -1..1. Its numbers cannot be compared with LPIPS of other papers, nor
    with ``lpips``. Use it only beside published numbers. Arguments and result are those of
    ``lpips``.

    Differentiable: no. Source: GSFusion's released evaluation.
    """
    a, b = both_on_8bit_grid(rgb, reference)
    return _network_distance(a.flip(-1), b.flip(-1))


def _network_distance(
    a: Float[Tensor, "H W 3"],
    b: Float[Tensor, "H W 3"],
) -> float | NotComputed:
    network = _lpips_network()
    if isinstance(network, NotComputed):
        return network
    a, b = (image.permute(2, 0, 1)[None].float().cpu() for image in (a, b))
    with torch.no_grad():
        return float(network(a, b))


def lpips_unavailable() -> NotComputed | None:
    """The reason why LPIPS cannot be computed on this machine, or None. Fast; nothing is
    downloaded."""
    network = _lpips_network()
    return network if isinstance(network, NotComputed) else None


@functools.cache
def _lpips_network():
    try:
        import lpips as package  # pyright: ignore[reportMissingImports]
        from torchvision.models import AlexNet_Weights  # pyright: ignore[reportMissingImports]
    except ImportError as e:
        return NotComputed(
            f"package {e.name!r} is not installed (pip install 'gsfusion-nb[lpips]')"
        )
    except (
        RuntimeError
    ) as e:  # a torchvision for another version of torch fails while it registers its operators
        return NotComputed(f"torchvision is not compatible with the installed torch ({e})")
    name = AlexNet_Weights.IMAGENET1K_V1.url.rsplit("/", 1)[-1]
    weights = Path(torch.hub.get_dir()) / "checkpoints" / name
    if not weights.is_file():  # otherwise the package would start a download
        return NotComputed(f"AlexNet's weights are not on this machine (expected {weights})")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the package calls torchvision by a deprecated keyword
        return package.LPIPS(net="alex", verbose=False).eval()
