"""Result of tracking one frame: its pose and how it was found."""

from dataclasses import dataclass
from typing import Literal

from jaxtyping import Float
from torch import Tensor

from ..types import Frame
from .icp import IcpResult


@dataclass(frozen=True, kw_only=True, eq=False)
class TrackingReport:
    """The pose of one frame and how it was found."""

    status: Literal["first", "ok", "degenerate", "recovered"]
    """"first": pose from the data; "degenerate": some directions of motion, which the scene does not determine, are
    predicted; "recovered": ICP failed from the predicted pose, also with smoothed normals, but not from another
    start."""
    T_WC: Float[Tensor, "4 4"]
    """Camera-to-world pose, float32."""
    start: str = ""
    """Where the successful ICP started: "the predicted pose", "the last pose", ..."""
    doubt: str = ""
    """Why other starts were tried although the first led to a pose within the limits."""
    n_inliers: int = 0
    inlier_share: float = 0.0
    """Correspondences as a share of the pixels with usable depth."""
    overlap_inlier_share: float = 0.0
    """Correspondences as a share of the pixels that fall on a known part of the model."""
    rms_m: float = 0.0
    """Weighted root mean square point-to-plane distance, metres."""
    eigenvalues: tuple[float, ...] = ()
    """Mean information of the six principal directions of motion, smallest first."""
    degenerate: int = 0
    """Number of these directions that the scene does not determine."""
    iterations: int = 0
    seconds: dict[str, float]
    """Wall-clock time of "preprocess", "render" and "icp"."""
    icp: IcpResult | None = None
    """Every step of the successful ICP; None for the first frame."""

    @classmethod
    def of(
        cls,
        result: IcpResult,
        frame: Frame,
        start: str,
        *,
        first_try: bool,
        seconds: dict[str, float],
        doubt: str = "",
    ) -> "TrackingReport":
        """Report of a frame that ICP aligned from the start named ``start``."""
        return cls(
            status="recovered" if not first_try else "degenerate" if result.degenerate else "ok",
            T_WC=result.T_WC.to(frame.T_WC),
            start=start,
            doubt=doubt,
            n_inliers=result.n_inliers,
            inlier_share=result.inlier_share,
            overlap_inlier_share=result.overlap_inlier_share,
            rms_m=result.rms_m,
            eigenvalues=result.eigenvalues,
            degenerate=result.degenerate,
            iterations=len(result.history),
            seconds=seconds,
            icp=result,
        )
