"""What each study compares: variants of one run, as options of ``gsfusion-nb map``."""

from dataclasses import dataclass

_RTG = ("--system", "rtg_slam")
_TRACKED = ("--tracking.poses", "tracked")


@dataclass(frozen=True)
class Study:
    """Runs that differ in one thing."""

    question: str
    variants: dict[str, tuple[str, ...]]
    """Label -> options."""


STUDIES: dict[str, Study] = {
    "systems": Study(
        "Both systems side by side, with given and with tracked poses",
        {
            "GSFusion, given": (),
            "RTG-SLAM, given": _RTG,
            "GSFusion, tracked": _TRACKED,
            "RTG-SLAM, tracked": (*_RTG, *_TRACKED),
        },
    ),
    "transparent": Study(
        "RTG-SLAM with and without transparent Gaussians (Peng et al. 2024, Fig. 6)",
        {
            "with transparent": _RTG,
            "opaque only": (*_RTG, "--rule-options", "transparent=false"),
        },
    ),
    "states": Study(
        "RTG-SLAM: optimise the unstable Gaussians and their pixels, or everything",
        {
            "unstable only": _RTG,
            "all Gaussians": (*_RTG, "--window.no-only-unstable"),
        },
    ),
    "fidelity": Study(
        "RTG-SLAM: where paper and released code differ",
        {name: (*_RTG, "--fidelity", name) for name in ("measured", "paper", "code")},
    ),
    "depth": Study(
        "RTG-SLAM online with disc depth or blended depth",
        {"disc depth": _RTG, "blended depth": (*_RTG, "--discs.depth", "blended")},
    ),
    "tracking": Study(
        "RTG-SLAM's tracker: what it is aligned to, and the back end",
        {
            "hybrid (released code)": (*_RTG, *_TRACKED),
            "model (paper)": (*_RTG, *_TRACKED, "--tracking.target", "model"),
            "hybrid, back end": (*_RTG, *_TRACKED, "--tracking.back-end.enabled"),
        },
    ),
}
"""Name on the command line -> what it compares. "disc-depth" (Fig. 7) is in ``disc_depth``."""
