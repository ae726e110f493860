"""A system of a user's own in one file, as text: Gaussians where a rule of the file puts them, a
few steps a frame, and tracking of its own. It imports a module from beside it."""

from pathlib import Path

HELPER = "EVERY_PX = 6\n"
SOURCE = '''"""A toy system."""

from dataclasses import dataclass, field

import torch
from toy_helper import EVERY_PX

from gsfusion_nb.config import OptimConfig, Presets, SeedingConfig, SystemConfig, TsdfConfig
from gsfusion_nb.mapping import SystemDescription, TsdfMapping
from gsfusion_nb.optim import adam_step, l1_mse_vjp
from gsfusion_nb.render import render_forward, render_vjp
from gsfusion_nb.seeding import seeding_rule
from gsfusion_nb.tsdf import integrate


@seeding_rule
def toy_grid(ctx, *, every_px: int = EVERY_PX):
    """Every n-th pixel of every n-th row."""
    uv = ctx.pixels()
    return ctx.seeds_at(uv[(uv.floor() % every_px == 0).all(dim=1)], every_px / 2)


@dataclass(frozen=True, kw_only=True)
class ToyConfig(SystemConfig):
    """Settings of the toy."""

    tsdf: TsdfConfig = field(default_factory=lambda: TsdfConfig(voxel_size_m=0.1))
    seeding: SeedingConfig = field(default_factory=lambda: SeedingConfig(rule="toy_grid"))
    sh_degree: int = 0
    steps: int = 2
    """Gradient steps of a frame. Larger: slower. Usual: 1 to 5."""


class Toy(TsdfMapping):
    """The mapper."""

    description = SystemDescription(title="Toy of one file")
    config_type = ToyConfig
    preset = Presets.of(ToyConfig, tum={"steps": 3})

    @property
    def n_passes(self):
        return 0

    def track_frame(self, frame):
        return self.localiser.locate_by(self.find_pose, frame)

    def find_pose(self, frame, T_predicted):
        """Its own tracking: it knows the pose of the data, but for a millimetre."""
        T_WC = frame.T_WC.clone()
        T_WC[0, 3] += 0.001
        return T_WC

    def map_frame(self, frame):
        seeds = self.propose_seeds(self.seed_context(frame, volume=self.volume, near_m=0.1))
        with self.transaction.changes():
            self.gaussians.append(seeds, frame.index)
            self.keyframes.append(frame)
            with self.clock("optimise"):
                losses = tuple(float(self._optimise(frame)) for _ in range(self.config.steps))
        with self.clock("tsdf"):
            integrate(self.volume, frame)
        return self.reports.of_frame(frame, seeds, True, losses=losses)

    def _global_step(self, i):
        return self._optimise(self.keyframes[i])

    def _optimise(self, view):
        output, record = render_forward(self.gaussians.params, view.camera, view.T_WC)
        loss = l1_mse_vjp(output.rgb, view.rgb)
        adam_step(self.gaussians, render_vjp(record, loss.v_rgb), OptimConfig())
        return loss.value
'''


def write_toy(folder: Path, source: str = SOURCE) -> str:
    """Write the file and the module beside it. Returns "FILE.py:Toy"."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "toy_helper.py").write_text(HELPER)
    (folder / "toy.py").write_text(source)
    return f"{folder / 'toy.py'}:Toy"
