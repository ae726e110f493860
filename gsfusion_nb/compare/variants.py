"""The variants that each study compares, as options of ``gsfusion-nb map``."""

from dataclasses import dataclass

_RTG = ("--system", "rtg_slam")
_GPS = ("--system", "gps_slam")
_TRACKED = ("--tracking.poses", "tracked")


@dataclass(frozen=True)
class Study:
    """Runs that differ in one respect, and the question that they answer."""

    question: str
    variants: dict[str, tuple[str, ...]]
    """Label -> options."""


RATE = "rate"
"""Name of the study that is also drawn: held-out PSNR over the time per frame."""

_GPS_ONLINE = (*_GPS, "--final.passes", "0")
_SURFACE = (*_GPS_ONLINE, "--rule-options", "share=0")

STUDIES: dict[str, Study] = {
    "systems": Study(
        "The three systems, with given and with tracked poses",
        {
            "GSFusion, given": (),
            "RTG-SLAM, given": _RTG,
            "GPS-SLAM, given": _GPS,
            "GSFusion, tracked": _TRACKED,
            "RTG-SLAM, tracked": (*_RTG, *_TRACKED),
            "GPS-SLAM, tracked": (*_GPS, *_TRACKED),
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
        "The three systems as measured, as in their papers and as released, scored on the same held-out views",
        {
            f"{title}, {name}": (*system, "--fidelity", name, "--data.hold-out-every", "8")
            for title, system in (("GSFusion", ()), ("RTG-SLAM", _RTG), ("GPS-SLAM", _GPS))
            for name in ("measured", "paper", "code")
        },
    ),
    "gsfusion-settings": Study(
        "GSFusion: the settings in which paper, released code and our defaults differ, changed one at a time",
        {
            "measured": (),
            "seeding.without_depth skip (both)": ("--seeding.without-depth", "skip"),
            "optim.adam_steps shared (both)": ("--optim.adam-steps", "shared"),
            "optim.adam_steps per_row": ("--optim.adam-steps", "per_row"),
            "optim.ssim_weight 0 (paper)": ("--optim.ssim-weight", "0"),
            "tsdf.sdf z (paper)": ("--tsdf.sdf", "z"),
            "tsdf.average eq9 (paper)": ("--tsdf.average", "eq9"),
            "tsdf.average int16 (code)": ("--tsdf.average", "int16"),
            "tsdf.outlier_guard off (both)": ("--tsdf.no-outlier-guard",),
            "seeding.one_per_voxel on (paper)": ("--seeding.one-per-voxel",),
        },
    ),
    "rtg-slam-settings": Study(
        "RTG-SLAM: the settings that our defaults take from measurements, set to the published value one at a time",
        {
            "measured": _RTG,
            "discs.opaque_alpha 0.61 (paper)": (*_RTG, "--discs.opaque-alpha", "0.6065"),
            "discs.min_cosine 0.5 (both)": (*_RTG, "--discs.min-cosine", "0.5"),
            "discs.max_offset 1 (code)": (*_RTG, "--discs.max-offset", "1"),
            "discs.max_offset none (paper)": (*_RTG, "--discs.max-offset", "None"),
            "share 0.05 (both)": (*_RTG, "--rule-options", "share=0.05"),
            "window.lr_sh 5e-4, 2.5e-5 (code)": (*_RTG, "--window.lr-sh-dc", "5e-4", "--window.lr-sh-rest", "2.5e-5"),
            "window.lr_log_scale 4e-3 (code)": (*_RTG, "--window.lr-log-scale", "4e-3"),
            "window.draw random (paper)": (*_RTG, "--window.draw", "random"),
            "states.stable_confidence 100 (code)": (*_RTG, "--states.stable-confidence", "100"),
            "states.age all (both)": (*_RTG, "--states.age", "all"),
        },
    ),
    "depth": Study(
        "RTG-SLAM online with disc depth or blended depth",
        {"disc depth": _RTG, "blended depth": (*_RTG, "--discs.depth", "blended")},
    ),
    RATE: Study(
        "Rate against held-out PSNR while mapping, without passes: GPS-SLAM with one changed setting beside GSFusion",
        {
            "GSFusion": ("--optim.global-iterations", "0"),
            "GPS-SLAM": _GPS_ONLINE,
            "10 steps": (*_GPS_ONLINE, "--schedule.iterations", "10"),
            "30 steps": (*_GPS_ONLINE, "--schedule.iterations", "30"),
            "40 steps": (*_GPS_ONLINE, "--schedule.iterations", "40"),
            "most 0.005": (*_GPS_ONLINE, "--rule-options", "most=0.005"),
            "most 0.04": (*_GPS_ONLINE, "--rule-options", "most=0.04"),
            "2 looks": (*_GPS_ONLINE, "--schedule.recalled", "2", "--schedule.recalled-new", "1"),
            "full looks": (*_GPS_ONLINE, "--base.resolution", "full"),
            "voxels 2 cm": (*_GPS_ONLINE, "--tsdf.voxel-size-m", "0.02"),
            "voxels 0.7 cm": (*_GPS_ONLINE, "--tsdf.voxel-size-m", "0.007"),
        },
    ),
    "colours": Study(
        "The TSDF's picture and its mesh, without Gaussians, by how its colours are weighted",
        {
            "band of 1.5 voxels and 1/z^2": _SURFACE,
            "band of 1.5 voxels": (*_SURFACE, "--tsdf.no-colour-by-distance"),
            "band of 2 voxels": (*_SURFACE, "--tsdf.no-colour-by-distance", "--tsdf.colour-band-voxels", "2"),
            "1/z^2": (*_SURFACE, "--tsdf.colour-band-voxels", "0"),
            "equal weights": (*_SURFACE, "--tsdf.no-colour-by-distance", "--tsdf.colour-band-voxels", "0"),
        },
    ),
    "tracking": Study(
        "RTG-SLAM's tracker: the surface it aligns to, and the back end",
        {
            "hybrid (released code)": (*_RTG, *_TRACKED),
            "model (paper)": (*_RTG, *_TRACKED, "--tracking.target", "model"),
            "hybrid, without landmarks": (*_RTG, *_TRACKED, "--tracking.landmarks.no-enabled"),
            "hybrid, back end": (*_RTG, *_TRACKED, "--tracking.back-end.enabled"),
        },
    ),
}
"""Name on the command line -> study. "disc-depth" (Fig. 7) is in ``disc_depth``."""
