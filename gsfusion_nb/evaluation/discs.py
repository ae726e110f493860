"""Distance between a map of discs and the true surface, without a mesh."""

import torch
from jaxtyping import Float
from torch import Tensor

from ..geometry import quaternion
from ..types import GaussianParams, Mesh
from .geometry import GeometryScores, sample_surface
from .not_computed import NotComputed


def sample_discs(params: GaussianParams, n: int, generator: torch.Generator) -> Float[Tensor, "n 3"]:
    """``n`` points spread evenly over the opaque discs, each with a radius of one standard deviation.

    A disc is drawn with probability a b / sum, its two largest standard deviations; inside it sqrt(u) makes the
    radius uniform over the area. Source: Peng et al. 2024, section 3.1 (the surfel's extent); the released evaluation
    takes the same number of points on every disc instead.
    """
    solid = params[params.opacity_logit > 0]
    if not len(solid):
        return params.xyz_W.new_zeros(0, 3).double()
    scale, axis = solid.log_scale.double().exp().sort(dim=1, descending=True)
    upto = (scale[:, 0] * scale[:, 1]).cumsum(0)
    draw = torch.rand(n, 3, generator=generator, dtype=torch.float64, device=generator.device).to(upto.device)
    row = torch.searchsorted(upto, draw[:, 0] * upto[-1], right=True).clamp(max=len(upto) - 1)
    r, angle = draw[:, 1].sqrt(), 2 * torch.pi * draw[:, 2]
    R = quaternion.to_matrix(solid.quat.double())[row]
    a, b = (R.gather(2, axis[row, k, None, None].expand(-1, 3, 1)).squeeze(2) for k in (0, 1))
    along_a, along_b = scale[row, 0] * r * angle.cos(), scale[row, 1] * r * angle.sin()
    return solid.xyz_W.double()[row] + along_a[:, None] * a + along_b[:, None] * b


def disc_scores(
    params: GaussianParams,
    reference: Mesh,
    *,
    generator: torch.Generator,
    threshold_m: float = 0.03,
    n_samples: int = 200_000,
) -> GeometryScores | NotComputed:
    """Accuracy and completion of the opaque discs against ``reference``, from samples of both.

    Args:
        params: The map.
        reference: The true surface, already reduced to the part that was seen (``cull_unseen``).
        generator: Draws the samples.
        threshold_m: Threshold of the shares, metres.
        n_samples: Number of points on each of the two surfaces.

    Differentiable: no.
    """
    from scipy.spatial import KDTree

    ours = sample_discs(params, n_samples, generator)
    if not len(ours):
        return NotComputed("the map has no opaque Gaussian")
    truth = sample_surface(reference, n_samples, generator).xyz_W
    points, surface = ours.cpu().numpy(), truth.cpu().numpy()
    to_truth = torch.from_numpy(KDTree(surface).query(points)[0])
    to_ours = torch.from_numpy(KDTree(points).query(surface)[0])
    return GeometryScores(
        accuracy_m=float(to_truth.mean()),
        completion_m=float(to_ours.mean()),
        precision=float((to_truth < threshold_m).double().mean()),
        completion_ratio=float((to_ours < threshold_m).double().mean()),
        threshold_m=threshold_m,
        distance="samples",
    )
