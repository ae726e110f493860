"""Settings of EGG-Fusion, by default those published for Replica."""

from dataclasses import dataclass

from gsfusion_nb.config import OptimConfig, Presets, SeedingConfig, SystemConfig

INSERTION = SeedingConfig(rule="egg_insertion")
RATES = OptimConfig(
    lr_xyz=1e-5,
    lr_sh_dc=1e-3,
    lr_sh_rest=5e-5,
    lr_opacity_logit=1e-5,
    lr_log_scale=5e-4,
    lr_quat=1e-4,
    adam_steps="per_row",
)


@dataclass(frozen=True, kw_only=True)
class EggConfig(SystemConfig):
    """All settings of a run, except where the data is."""

    seeding: SeedingConfig = INSERTION
    optim: OptimConfig = RATES
    alpha_p: float = 1.0
    """Standard deviation of a measured centre, as a share of its depth. Larger: slower filter."""
    alpha_n: float = 0.5
    """The same of a measured normal."""
    fuse_within_m: float = 0.03
    """A surfel is fused if it is so near to the rendered and to the measured depth, metres."""
    stable_information: float = 10.0
    """A surfel is stable when the information of its centre and its normal is larger."""
    window_every: int = 3
    """Every n-th mapped frame joins the window of the latest three."""
    round_every: int = 6
    """Optimise once in this many frames. Larger: faster, rougher."""
    round_steps: int = 9
    """Gradient steps of a round. Larger: better pictures, slower."""
    first_steps: int = 20
    """Gradient steps on the first frame."""
    final_passes: int = 10
    """Passes over the keyframes after the scan. Published: 60 on Replica, 20 on ScanNet++."""
    depth_weight: float = 1.0
    """w_d: weight of the depth error in metres."""
    normal_weight: float = 1.0
    """w_n: weight of 1 - cosine of the angle between measured and rendered normals."""
    state_weight: float = 10.0
    """w_reg: weight of how far a round leads from the filtered centres."""
    state_normal_weight: float = 1.0
    """w_rn: weight of the normals in it, beside the centres."""
    mesh_voxel_m: float = 0.02
    """Edge of the voxels that the mesh is made from, metres."""


_SCANNETPP = {
    "alpha_p": 0.5,
    "alpha_n": 1.0,
    "fuse_within_m": 0.05,
    "window_every": 1,
    "round_every": 3,
    "round_steps": 24,
    "final_passes": 20,
    "depth_weight": 0.1,
    "state_weight": 5.0,
    "optim": {
        "lr_sh_dc": 5e-3,
        "lr_sh_rest": 2.5e-4,
        "lr_opacity_logit": 1e-4,
        "lr_log_scale": 1e-3,
    },
    "seeding": {"options": {"min_alpha": 0.99, "behind_m": 0.1, "share": 0.125, "size_px": 3.0}},
}
_TUM = {
    "alpha_p": 0.5,
    "alpha_n": 1.0,
    "fuse_within_m": 0.1,
    "window_every": 5,
    "round_every": 3,
    "round_steps": 15,
    "depth_weight": 0.1,
    "normal_weight": 0.1,
    "state_weight": 1.0,
    "sh_degree": 0,
    "optim": {"lr_xyz": 1e-4, "lr_sh_dc": 2e-2, "lr_opacity_logit": 1e-4, "lr_log_scale": 1e-4},
    "seeding": {"options": {"min_alpha": 0.5, "behind_m": 0.1, "share": 0.1, "size_px": 1.0}},
}
_ROOM = _SCANNETPP | {
    "data": {"width": 320, "height": 240},
    "seeding": {"options": {"min_alpha": 0.9, "behind_m": 0.1, "share": 0.5, "size_px": 1.5}},
}
"""As for ScanNet++, whose views are far apart, too; with more surfels a frame, since the pictures
are small."""
egg_fusion = Presets.of(EggConfig, scannetpp=_SCANNETPP, tum=_TUM, room=_ROOM)
"""Settings as published for a data set."""
