"""The Gaussian map: rows of parameters and the rows of their optimiser, which are added and removed
together."""

import dataclasses
from collections.abc import Callable
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from ..backends import observed
from ..checks import check_shape
from ..edit_count import edit_count
from ..errors import ArgumentError
from ..geometry import quaternion
from ..geometry.spherical_harmonics import SH_C0, rgb_to_sh_dc
from ..resources import MAP_MEMORY
from ..types import ALL_ROWS, GaussianParams, MapRows, Seeds
from .edit import Edit, apply_edit
from .rigid_motion import turn_colours_, turn_moments_
from .rows import GrowingRows
from .step_clock import StepClock, StepCount

PARAMETERS = tuple(f.name for f in dataclasses.fields(GaussianParams))


class GaussianModel(GrowingRows):
    """A map of Gaussians and the state of Adam for each of them.

    Rows are stored in buffers that grow by a factor when full; every property is a view of the rows
    in use. Rows change only through ``append``, ``edit``, ``keep``, ``move`` and the optimiser, so
    parameters and moments always belong together. Two kinds of columns exist only once they are
    used: factors of learning rates (``rates``), and numbers that a seeding rule keeps for each row
    (``memory``).
    """

    _COUNTS: tuple[str, ...] = ("birth_frame", "birth_step", "last_step", "tag")
    """Columns of whole numbers."""
    _MOMENTS: tuple[str, ...] = ("exp_avg", "exp_avg_sq")
    _POSE_PREFIXES: tuple[str, ...] = ("",)
    """Prefixes of the columns that hold centres and orientations, which move when a loop is
    closed."""

    def __init__(self, sh_degree: int = 3, device: torch.device | str = "cpu"):
        if sh_degree not in (0, 1, 2, 3):
            raise ArgumentError(f"sh_degree must be 0, 1, 2 or 3, got {sh_degree}")
        self.sh_degree = sh_degree
        self.device = torch.device(device)
        self._steps = StepCount()
        super().__init__(self._column_names())
        self._views: dict[str, tuple[Tensor, GaussianParams]] = {}
        """Prefix -> buffer of the last column when they were made, and views of the rows in use."""

    def __repr__(self) -> str:
        return (
            f"GaussianModel({len(self):,} Gaussians, SH degree {self.sh_degree}, "
            f"{self.size_bytes / 1e6:.1f} MB as PLY)"
        )

    @property
    def params(self) -> GaussianParams:
        """Parameters before activation; views, so the optimiser updates them in place. The same
        ones until the number of rows changes."""
        return self._rows("")

    @property
    def exp_avg(self) -> GaussianParams:
        """Adam's running mean of the gradient."""
        return self._rows("exp_avg.")

    @property
    def exp_avg_sq(self) -> GaussianParams:
        """Adam's running mean of the squared gradient."""
        return self._rows("exp_avg_sq.")

    @property
    def birth_frame(self) -> Int[Tensor, " N"]:
        """Index of the frame that seeded each row."""
        return self._columns["birth_frame"][: self._count]

    @property
    def clock(self) -> StepClock:
        """When each row began, and the last step in which it took part: views, which the optimiser
        changes."""
        return StepClock(self._steps, self.birth_step, self.last_step)

    @property
    def step_count(self) -> int:
        """Optimiser steps so far, shared by all rows. When it is set, no row misses steps."""
        return self._steps.value

    @step_count.setter
    def step_count(self, count: int) -> None:
        self.clock.advance(count)

    @property
    def birth_step(self) -> Int[Tensor, " N"]:
        """Value of ``step_count`` when each row was added, or its moments were forgotten."""
        return self._columns["birth_step"][: self._count]

    @property
    def last_step(self) -> Int[Tensor, " N"]:
        """Value of ``step_count`` after the last step of the optimiser in which each row took
        part."""
        return self._columns["last_step"][: self._count]

    @property
    def tag(self) -> Int[Tensor, " N"]:
        """Label that the seeding rule gave each row."""
        return self._columns["tag"][: self._count]

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

    @property
    def size_bytes(self) -> int:
        """Size of the map in the standard PLY layout: 62 float32 per Gaussian."""
        return 62 * 4 * len(self)

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
        start = self._count
        stop = self._count + len(params)
        self._reserve(stop)
        for name in (*PARAMETERS[:-1], *self._moment_names()):
            self._columns[name][start:stop] = getattr(params, name) if name in PARAMETERS else 0.0
        K = min(params.sh.shape[1], (self.sh_degree + 1) ** 2)
        self._columns["sh"][start:stop] = 0.0
        self._columns["sh"][start:stop, :K] = params.sh[:, :K]
        for name, value in (("birth_frame", frame_index), ("tag", 0)):
            self._columns[name][start:stop] = value
        self._fill_optional(slice(start, stop))
        self._in_use(stop)
        self.as_new(slice(start, stop))

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
        n = len(seeds)
        if n == 0:
            return
        check_shape("seeds.xyz_W", seeds.xyz_W, (n, 3))
        values = {"xyz_W": seeds.xyz_W, "quat": seeds.quat, "rgb": seeds.rgb}
        values |= {"scale_m": seeds.scale_m.log(), "opacity": seeds.opacity.logit()}
        # a GPU is waited for once
        if bool(torch.cat([v.reshape(-1) for v in values.values()]).isnan().any()):
            name, row = next(
                (k, int(v.isnan().nonzero()[0, 0])) for k, v in values.items() if v.isnan().any()
            )
            raise ArgumentError(
                "new Gaussians need numbers that are not NaN, scales >= 0 and opacities in 0..1, "
                f"got {getattr(seeds, name)[row].tolist()} as {name} of row {row}"
            )
        start = self._count
        stop = self._count + n
        self._reserve(stop)
        new = self._columns
        new["xyz_W"][start:stop] = seeds.xyz_W
        new["log_scale"][start:stop] = values["scale_m"]
        new["quat"][start:stop] = seeds.quat
        new["opacity_logit"][start:stop] = values["opacity"]
        if start < self._most:  # rows beyond, which were never in use, are zero
            for name in ("sh", *self._moment_names()):
                new[name][start:stop] = 0.0
        new["sh"][start:stop, 0] = rgb_to_sh_dc(seeds.rgb)
        new["birth_frame"][start:stop] = frame_index
        new["tag"][start:stop] = seeds.tag
        self._fill_optional(slice(start, stop))
        self._in_use(stop)
        self.as_new(slice(start, stop))

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

    def copy_rows(self, rows: Int[Tensor, " M"]) -> None:
        """Append a copy of each of these rows, with zero moments; row numbers may repeat."""
        start = len(self)
        super().copy_rows(rows)
        self.clear_moments(slice(start, None))
        self.as_new(slice(start, None))

    def as_new(self, rows: MapRows) -> None:
        """Count these rows as added now."""
        self.clock.begin(rows)

    def clear_moments(
        self,
        rows: MapRows,
        parameter: str | None = None,
    ) -> None:
        """Set Adam's moments of these rows to zero, of all parameters or of one."""
        for name in self._moment_names():
            if parameter is None or name.endswith(f".{parameter}"):
                self._columns[name][: self._count][rows] = 0.0

    def restart_optimiser(self) -> None:
        """Forget all moments; the steps of every row are counted from here."""
        self.clear_moments(ALL_ROWS)
        self.clock.begin(ALL_ROWS)

    def log_changes(self) -> Callable[[], None]:
        """Also the number of steps is brought back."""
        undo_rows = super().log_changes()
        count = self.step_count

        def undo() -> None:
            undo_rows()
            self._steps.value = count

        return undo

    def move(self, T: Float[Tensor, "N 4 4"]) -> None:
        """Apply a rigid motion to each row (a loop closure): centre, orientation, colour, and
        Adam's moments."""
        for prefix in self._POSE_PREFIXES:
            xyz, quat = (
                self._columns[f"{prefix}{name}"][: self._count] for name in ("xyz_W", "quat")
            )
            turn = T.to(xyz)
            xyz.copy_((turn[:, :3, :3] @ xyz[:, :, None]).squeeze(2) + turn[:, :3, 3])
            quat.copy_(
                quaternion.multiply(
                    quaternion.from_matrix(turn[:, :3, :3]), quaternion.normalise(quat)
                )
            )
        R = T[:, :3, :3].to(self.device)
        turn_colours_(self.params.sh, R)
        if self._MOMENTS:
            turn_moments_(self.exp_avg, self.exp_avg_sq, R)

    @property
    def edits(self) -> tuple[int, ...]:
        """Another value when any value of the map has changed, or the number of rows or steps."""
        return (len(self), self.step_count, *edit_count(*self._columns.values()))

    def state_dict(self, *, copies: bool = True) -> dict[str, Any]:
        """Everything needed to continue later, as tensors and numbers; without ``copies`` steps
        change the tensors."""
        columns = self.snapshot() if copies else self.columns
        rows = {name: column for name, column in columns.items() if not name.startswith("trace.")}
        return {"sh_degree": self.sh_degree, "step_count": self.step_count, "rows": rows}

    @classmethod
    def from_state_dict(
        cls, state: dict[str, Any], device: torch.device | str = "cpu"
    ) -> "GaussianModel":
        """The model that was saved with ``state_dict``."""
        model = cls(state["sh_degree"], device)
        model._steps.value = state["step_count"]
        count = state["rows"]["xyz_W"].shape[0]
        model._reserve(count)
        for name in state["rows"]:
            if name.startswith(tuple(cls._OPTIONAL)):
                model._use(name)
        for name, column in model._columns.items():
            column[:count] = state["rows"][name]
        model._in_use(count)
        model.clock.repair()
        return model

    def _rows(self, prefix: str) -> GaussianParams:
        last = self._columns[prefix + PARAMETERS[-1]]
        buffer, views = self._views.get(prefix, (None, None))
        if (
            views is not None
            and buffer is last
            and len(views) == self._count
            and not _is_differentiated(views)
        ):
            return views
        views = GaussianParams(
            **{name: self._columns[prefix + name][: self._count] for name in PARAMETERS}
        )
        self._views[prefix] = (last, views)
        return views

    def _moment_names(self) -> list[str]:
        return [f"{moment}.{name}" for moment in self._MOMENTS for name in PARAMETERS]

    def _column_names(self) -> list[str]:
        return [*PARAMETERS, *self._moment_names(), *self._COUNTS]

    def _new_column(self, name: str, capacity: int) -> Tensor:
        if name in self._COUNTS:
            return MAP_MEMORY.rows(capacity, dtype=torch.int32, device=self.device)
        widths = {
            "xyz_W": (3,),
            "log_scale": (3,),
            "quat": (4,),
            "opacity_logit": (),
            "sh": ((self.sh_degree + 1) ** 2, 3),
        }
        return MAP_MEMORY.rows(
            capacity,
            *widths[name.split(".")[-1]],
            device=self.device,
        )

    def _reserve(self, count: int) -> None:
        if count > self._capacity:
            self._views.clear()  # of the old buffers
        super()._reserve(count)


def _is_differentiated(params: GaussianParams) -> bool:
    """Whether somebody asked for a derivative of one of these columns."""
    return any(column.requires_grad for column in vars(params).values())
