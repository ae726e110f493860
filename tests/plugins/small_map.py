"""The map of which other programs made the files in ``tests/export/foreign``."""

import torch

from gsfusion_nb.types import GaussianParams


def small_map(n: int = 40, degree: int = 3) -> GaussianParams:
    """Gaussians of usual sizes and colours; the numbers are sines, so that they are the same everywhere."""
    row = torch.arange(n, dtype=torch.float64)[:, None]

    def waves(width: int, speed: float) -> torch.Tensor:
        return torch.sin(speed * row + 1.3 * torch.arange(width, dtype=torch.float64)[None])

    quat = waves(4, 0.7) + torch.tensor([0.1, 0.0, 0.0, 0.0])
    return GaussianParams(
        xyz_W=(waves(3, 0.9) * torch.tensor([2.0, 1.0, 1.5]) + torch.tensor([0.0, 0.5, 3.0])).float(),
        log_scale=(waves(3, 1.7) - 3.5).float(),
        quat=(quat / quat.norm(dim=1, keepdim=True)).float(),
        opacity_logit=(2.5 * waves(1, 2.1)[:, 0]).float(),
        sh=torch.cat([waves(3, 1.1)[:, None], 0.3 * waves(45, 0.6).view(n, 15, 3)], dim=1)[
            :, : (degree + 1) ** 2
        ].float(),
    )
