"""The Gaussian map: rows of parameters and the rows of their optimiser, which are added and removed
together."""

from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ..backends import observed
from ..checks import check_shape
from ..errors import ArgumentError
from ..geometry.spherical_harmonics import SH_C0, rgb_to_sh_dc
from ..types import GaussianParams, MapRows, Seeds
from .apply_edit import apply_edit
from .columns import PARAMETERS, GaussianColumns, Layout, OptionalColumns
from .edit import Edit
from .moments import MOMENTS, Moments
from .step_clock import StepClock, StepCount
from .undo_log import UndoLog

PLY_BYTES = 62 * 4
"""Of a Gaussian in the standard PLY layout: 62 float32."""


class GaussianModel:
    """A map of Gaussians and the state of Adam for each of them.

    Rows change only through ``append``, ``edit``, ``keep`` and the optimiser, so parameters and
    moments always belong together. Every property is a view of the rows in use.
    """

    _FLOATS: tuple[str, ...] = (
        *PARAMETERS,
        *(moment + name for moment in MOMENTS for name in PARAMETERS),
    )
    """Columns of floats; what follows a dot has the shape of that parameter."""
    _COUNTS: tuple[str, ...] = ("birth_frame", "birth_step", "last_step", "tag")
    """Columns of whole numbers."""

    def __init__(self, sh_degree: int = 3, device: torch.device | str = "cpu"):
        if sh_degree not in (0, 1, 2, 3):
            raise ArgumentError(f"sh_degree must be 0, 1, 2 or 3, got {sh_degree}")
        self.sh_degree = sh_degree
        self.device = torch.device(device)
        layout = _layout(self._FLOATS, self._COUNTS, sh_degree)
        self.columns = GaussianColumns(layout, self.device)
        """All that is stored for each row, by name."""
        self.rates = OptionalColumns(self.columns, "rate.", 1.0)
        """Parameter -> factor of its learning rate in each row, for the parameters that have
        any."""
        self.memory = OptionalColumns(self.columns, "memory.", 0.0)
        """Numbers that a seeding rule keeps for each row, by name; see ``row_memory``."""
        self.traces = OptionalColumns(self.columns, "trace.", 0.0)
        """Numbers that an observer gives each row. They are removed and copied together with their
        row, and not saved."""
        self._steps = StepCount()
        self.undo_log = UndoLog(self.columns, self._steps)
        """Rows as they were before they changed, while a frame may be undone."""

    def __len__(self) -> int:
        return self.columns.n_rows

    def __repr__(self) -> str:
        return (
            f"GaussianModel({len(self):,} Gaussians, SH degree {self.sh_degree}, "
            f"{PLY_BYTES * len(self) / 1e6:.1f} MB as PLY)"
        )

    @property
    def params(self) -> GaussianParams:
        """Parameters before activation; views, so the optimiser updates them in place. The same
        ones until the number of rows changes."""
        return self.columns.parameters()

    @property
    def moments(self) -> Moments:
        """Adam's moments."""
        return Moments(*(self.columns.parameters(moment) for moment in MOMENTS))

    @property
    def birth_frame(self) -> Int[Tensor, " N"]:
        """Index of the frame that seeded each row."""
        return self.columns["birth_frame"]

    @property
    def clock(self) -> StepClock:
        """When each row began, and the last step in which it took part: views, which the optimiser
        changes."""
        return StepClock(self._steps, self.columns["birth_step"], self.columns["last_step"])

    @property
    def tag(self) -> Int[Tensor, " N"]:
        """Label that the seeding rule gave each row."""
        return self.columns["tag"]

    @property
    def scale_m(self) -> Float[Tensor, "N 3"]:
        """Standard deviations, metres."""
        return self.params.log_scale.exp()

    @property
    def opacity(self) -> Float[Tensor, " N"]:
        """Peak opacities, 0..1."""
        return self.params.opacity_logit.sigmoid()

    @property
    def rgb(self) -> Float[Tensor, "N 3"]:
        """View-independent part of the colour, 0..1."""
        return (self.params.sh[:, 0] * SH_C0 + 0.5).clamp(0, 1)

    def row_memory(self, name: str) -> Float[Tensor, " N"]:
        """A number for each row, 0 at first, which is removed, copied and saved together with its
        row; a view."""
        return self.memory.use(name)

    def extend(self, params: GaussianParams, frame_index: int = -1) -> None:
        """Add rows that were optimised elsewhere, with zero moments; colours are cut or padded to
        the map's SH degree.

        Args:
            params: The rows, in the frame of the map.
            frame_index: Stored as ``birth_frame``; -1 means before the first frame.

        Raises:
            ValueError: a number is NaN or infinite. The map is unchanged.
        """
        bad = {name: int((~column.isfinite()).sum()) for name, column in vars(params).items()}
        if any(bad.values()):
            raise ArgumentError(
                f"Gaussians to begin with must be finite, got NaN or infinities: {bad}"
            )
        rows = self.columns.new_rows(len(params))
        for name in PARAMETERS[:-1]:
            self.columns[name][rows] = getattr(params, name)
        K = min(params.sh.shape[1], (self.sh_degree + 1) ** 2)
        self.columns["sh"][rows, :K] = params.sh[:, :K]
        self.birth_frame[rows] = frame_index
        self.rates.reset(rows)
        self.as_new(rows)

    @observed
    def append(self, seeds: Seeds, frame_index: int = 0) -> None:
        """Add rows for ``seeds``; their moments start at zero (GSFusion III-B.2).

        Args:
            seeds: New Gaussians, activated values.
            frame_index: Number of the frame they come from, stored as ``birth_frame``.

        Raises:
            ValueError: a value is NaN, a scale is negative, or an opacity is not in 0..1. The map
                is unchanged.
        """
        if not len(seeds):
            return
        log_scale = seeds.scale_m.log()
        opacity_logit = seeds.opacity.logit()
        _check_seeds(seeds, log_scale, opacity_logit)
        rows = self.columns.new_rows(len(seeds))
        params = self.params
        params.xyz_W[rows] = seeds.xyz_W
        params.log_scale[rows] = log_scale
        params.quat[rows] = seeds.quat
        params.opacity_logit[rows] = opacity_logit
        params.sh[rows, 0] = rgb_to_sh_dc(seeds.rgb)
        self.birth_frame[rows] = frame_index
        self.tag[rows] = seeds.tag
        self.rates.reset(rows)
        self.as_new(rows)

    def keep(self, rows: Bool[Tensor, " N"]) -> None:
        """Remove every row where ``rows`` is false, with all that is stored for it; the order is
        kept."""
        self.columns.keep(rows)

    def edit(
        self, edit: Edit, generator: torch.Generator, frame_index: int = 0
    ) -> Int[Tensor, " M"]:
        """Change rows as ``edit`` says, in the order of its fields; parameters, moments, birth and
        tag stay together.

        Args:
            edit: What to change.
            generator: Where the halves of a split row go is drawn from it.
            frame_index: Number of the frame, stored as ``birth_frame`` of the Gaussians in
                ``edit.add``; copies have the ``birth_frame`` of their row, and like all new rows
                the present ``birth_step``.

        Returns:
            For each of the rows after the edit its number before, -1 for new rows. [M]

        Raises:
            ValueError: see ``Edit``. The map is unchanged.
        """
        return apply_edit(self, edit, generator, frame_index)

    def set_rows(
        self,
        name: str,
        rows: Int[Tensor, " M"],
        values: Tensor,
    ) -> None:
        """Write the values of some rows of a column, as they are stored."""
        self.columns[name][rows] = values.to(self.columns[name])

    def as_new(self, rows: MapRows) -> None:
        """Count these rows as added now."""
        self.clock.begin(rows)

    def state_dict(self, *, copies: bool = True) -> dict[str, Any]:
        """Everything needed to continue later, as tensors and numbers; without ``copies`` steps
        change the tensors."""
        columns = self.columns.snapshot() if copies else self.columns
        rows = {name: column for name, column in columns.items() if not name.startswith("trace.")}
        return {"sh_degree": self.sh_degree, "step_count": self.clock.count, "rows": rows}

    @classmethod
    def from_state_dict(
        cls, state: dict[str, Any], device: torch.device | str = "cpu"
    ) -> "GaussianModel":
        """The model that was saved with ``state_dict``."""
        model = cls(state["sh_degree"], device)
        model._steps.value = state["step_count"]
        saved_rows = state["rows"]
        for name in saved_rows:
            if name.startswith(("rate.", "memory.")):
                model.columns.add(name, 0.0)
        model.columns.new_rows(len(saved_rows["xyz_W"]))
        for name, column in model.columns.items():
            column[:] = saved_rows[name]
        model.clock.repair()
        return model


def _layout(floats: tuple[str, ...], counts: tuple[str, ...], sh_degree: int) -> Layout:
    """Shapes and types of the columns of a map."""
    shapes: dict[str, tuple[int, ...]] = {
        "xyz_W": (3,),
        "log_scale": (3,),
        "quat": (4,),
        "opacity_logit": (),
        "sh": ((sh_degree + 1) ** 2, 3),
    }
    numbers = {name: (shapes[name.split(".")[-1]], torch.float32) for name in floats}
    return numbers | dict.fromkeys(counts, ((), torch.int32))


def _check_seeds(seeds: Seeds, log_scale: Tensor, opacity_logit: Tensor) -> None:
    """Raise ``ValueError`` for new Gaussians that cannot be stored; a GPU is waited for once."""
    check_shape("seeds.xyz_W", seeds.xyz_W, (len(seeds), 3))
    stored = {
        "xyz_W": seeds.xyz_W,
        "quat": seeds.quat,
        "rgb": seeds.rgb,
        "scale_m": log_scale,
        "opacity": opacity_logit,
    }
    if not bool(torch.cat([values.reshape(-1) for values in stored.values()]).isnan().any()):
        return
    name = next(name for name, values in stored.items() if values.isnan().any())
    row = int(stored[name].isnan().nonzero()[0, 0])
    raise ArgumentError(
        "new Gaussians need numbers that are not NaN, scales >= 0 and opacities in 0..1, "
        f"got {getattr(seeds, name)[row].tolist()} as {name} of row {row}"
    )
