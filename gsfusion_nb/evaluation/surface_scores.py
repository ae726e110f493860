"""Scores of a surface: a mesh or a map of discs against the truth, and the centres of Gaussians
against the run's own mesh.

No ICP alignment is applied: a map made from given poses is in the world frame of its ground truth,
and aligning it would hide a systematic shift. Distances are stored in metres and printed in
centimetres.
"""

import math

import torch
from torch import Tensor

from ..checks import check_positive
from ..types import GaussianParams, Mesh
from .metrics import NotComputed
from .point_distances import distance_to_mesh, distance_to_points
from .surface_samples import sample_discs, sample_surface, samples_by_area
from .triangles import face_areas

SAMPLES_PER_M2 = 10_000
"""One point per cm^2, as GSFusion's released evaluation draws on the mesh."""
SAMPLES_AT_A_TIME = 1 << 20
"""Limits the memory for intermediate results."""


def mesh_scores(
    mesh: Mesh,
    reference: Mesh,
    *,
    generator: torch.Generator,
    threshold_m: float = 0.03,
    n_samples: int = 200_000,
) -> dict[str, float] | NotComputed:
    """Accuracy and completion of ``mesh`` against ``reference``, from even samples of both
    surfaces.

    Args:
        mesh: The reconstruction.
        reference: The true surface, already reduced to the part that was seen (``cull_unseen``).
        generator: Draws the samples.
        threshold_m: For precision, completion ratio and F-score, metres.
        n_samples: Points drawn on each surface.

    Returns:
        Mean distance from the reconstruction to the truth (``accuracy_m``) and back
        (``completion_m``), metres; share of either that is nearer than the threshold to the other
        (``precision``, ``completion_ratio``), their harmonic mean (``f_score``), and
        ``threshold_m``; or the reason why there are none.

    Differentiable: no. Source: accuracy and completion as in iMAP (Sucar et al. 2021), sampled as
    NICE-SLAM does.
    """
    check_positive("threshold_m", threshold_m)
    check_positive("n_samples", n_samples)
    if len(mesh.faces) == 0:
        return NotComputed("the reconstructed mesh has no faces")
    ours = sample_surface(mesh, n_samples, generator)
    truth = sample_surface(reference, n_samples, generator)
    return _scores(
        distance_to_mesh(ours[0], reference, truth),
        distance_to_mesh(truth[0], mesh, ours),
        threshold_m,
    )


def disc_scores(
    params: GaussianParams,
    reference: Mesh,
    *,
    generator: torch.Generator,
    threshold_m: float = 0.03,
    n_samples: int = 200_000,
) -> dict[str, float] | NotComputed:
    """Accuracy and completion of the opaque discs against ``reference``, named as by
    ``mesh_scores``, from samples.

    Args:
        params: The map.
        reference: The true surface, already reduced to the part that was seen (``cull_unseen``).
        generator: Draws the samples.
        threshold_m: Threshold of the shares, metres.
        n_samples: Number of points on each of the two surfaces.

    Differentiable: no.
    """
    ours = sample_discs(params, n_samples, generator)
    if not len(ours):
        return NotComputed("the map has no opaque Gaussian")
    truth, _ = sample_surface(reference, n_samples, generator)
    return _scores(distance_to_points(ours, truth), distance_to_points(truth, ours), threshold_m)


def centres_to_own_mesh(
    params: GaussianParams, mesh: Mesh, *, generator: torch.Generator
) -> tuple[float, float] | NotComputed:
    """How far the Gaussian centres are from the run's own mesh, as GSFusion's released evaluation
    measures it.

    One way only, from every centre (also of transparent Gaussians) to the nearest of the points
    drawn on the mesh, one per cm^2. It says how well the two maps of a run agree, not how accurate
    either is: a mesh in the wrong place with Gaussians on it scores well. Accuracy against a true
    surface is ``mesh_scores``. Even for centres exactly on the mesh it is about half the sample
    spacing of 1 cm.

    Args:
        params: The map.
        mesh: The mesh of the same run.
        generator: Draws the samples.

    Returns:
        Mean distance, metres ("L1 SCD" of the released evaluation), and mean squared distance,
        square metres ("L2 SCD"), or the reason why there are none.

    Differentiable: no. Source: GSFusion's released evaluation (``eval_pcd.py``).
    """
    if not len(params):
        return NotComputed("the map has no Gaussian")
    if n_lost := int((~params.xyz_W.isfinite().all(1)).sum()):
        return NotComputed(f"the centres of {n_lost} Gaussians are not finite")
    areas = face_areas(mesh)
    n = int(areas.sum() * SAMPLES_PER_M2)
    area_sums = areas.cumsum(0)
    if n == 0:
        return NotComputed("the run's mesh is smaller than 1 cm^2")
    xyz = params.xyz_W.double()
    distance = torch.full((len(params),), math.inf, dtype=torch.float64)
    for start in range(0, n, SAMPLES_AT_A_TIME):
        samples = samples_by_area(mesh, area_sums, min(SAMPLES_AT_A_TIME, n - start), generator)[0]
        distance = torch.minimum(distance, distance_to_points(xyz, samples))
    return float(distance.mean()), float(distance.square().mean())


def _scores(to_truth: Tensor, to_ours: Tensor, threshold_m: float) -> dict[str, float]:
    precision, recall = (
        float((distance < threshold_m).double().mean()) for distance in (to_truth, to_ours)
    )
    return {
        "accuracy_m": float(to_truth.cpu().numpy().mean()),
        "completion_m": float(to_ours.cpu().numpy().mean()),
        "precision": precision,
        "completion_ratio": recall,
        "f_score": 2 * precision * recall / (precision + recall) if precision + recall > 0 else 0.0,
        "threshold_m": threshold_m,
    }
