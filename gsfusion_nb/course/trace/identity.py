"""Which Gaussian is in which row: every Gaussian has a number of its own from its birth to its end."""

from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from ...gaussians import Edit
from ...geometry import project, se3
from ...types import Camera, Seeds
from .records import SeedingRecord


@dataclass(frozen=True, kw_only=True, eq=False)
class Birth:
    """How a Gaussian came into the map."""

    id: int
    cause: str
    """"seed", "clone", "split", "added by the rule", or "before the trace"."""
    frame_index: int | None
    """The frame; ``None`` in the passes after the scan."""
    step: int
    """Optimiser steps (RTG-SLAM: frames) of the map so far."""
    rule: str
    """Name of the seeding rule; "" if it was in the map before the trace began."""
    uv: tuple[float, float] | None = None
    """Pixel that it was seeded from."""
    cell: tuple[int, int, int, int, int] | None = None
    """Quadtree leaf around that pixel: first column, first row, width, height, level. ``None`` without a quadtree."""
    voxel_W: float | None = None
    """Observation count of its voxel, with the frame fused, if the rule asked for it."""
    parent: int | None = None
    """Identity of the Gaussian that it is a copy or a half of."""
    tag: int = 0
    """Label that the rule gave it."""

    def __str__(self) -> str:
        where = "" if self.frame_index is None else f" in frame {self.frame_index}"
        words = [f"{self.cause}{where}"]
        words += [f"rule {self.rule}"] if self.rule else []
        words += [f"of Gaussian {self.parent}"] if self.parent is not None else []
        words += [f"pixel ({self.uv[0]:.1f}, {self.uv[1]:.1f})"] if self.uv else []
        if self.cell:
            x, y, w, h, level = self.cell
            words.append(f"quadtree cell {w} x {h} px at ({x}, {y}), level {level}")
        words += [f"its voxel has W = {self.voxel_W:g}"] if self.voxel_W is not None else []
        return ", ".join(words)


@dataclass(frozen=True, kw_only=True)
class Event:
    """A change of rows between two optimisation steps, or the end of a Gaussian."""

    serial: int
    frame_index: int | None
    what: str
    """"removed", "split", "cloned", "relocated", "moved to" (another was relocated to it), "set", "states"."""
    ids: tuple[int, ...]
    others: tuple[int, ...] = ()
    """For "relocated": where to; for "moved to": who came."""
    ends: bool = False

    def of(self, i: int) -> str:
        """The event of Gaussian ``i`` in words."""
        frame = "after the scan" if self.frame_index is None else f"frame {self.frame_index}"
        other = f" {self.others[self.ids.index(i)]}" if self.others else ""
        return f"{frame}: {self.what}{other}"


@dataclass(frozen=True, kw_only=True, eq=False)
class _Group:
    first: int
    cause: str
    frame_index: int | None
    step: int
    rule: str
    tag: Int[Tensor, " n"]
    parent: Int[Tensor, " n"] | None = None
    uv: Float[Tensor, "n 2"] | None = None
    cell: Int[Tensor, "n 5"] | None = None
    voxel_W: Float[Tensor, " n"] | None = None

    def birth(self, i: int) -> Birth:
        k, cell, uv = i - self.first, None, None
        if self.cell is not None and int(self.cell[k, 2]) > 0:
            x0, y0, width, height, level = self.cell[k].tolist()
            cell = (x0, y0, width, height, level)
        if self.uv is not None:
            uv = (float(self.uv[k, 0]), float(self.uv[k, 1]))
        W = float("nan") if self.voxel_W is None else float(self.voxel_W[k])
        return Birth(
            id=i, cause=self.cause, frame_index=self.frame_index, step=self.step, rule=self.rule,
            tag=int(self.tag[k]), parent=None if self.parent is None else int(self.parent[k]), uv=uv, cell=cell,
            voxel_W=None if W != W else W,
        )  # fmt: skip


class Identities:
    """The identities of the rows of one map. They move with the rows, in a column that no one else uses.

    Memory: about 60 bytes for each Gaussian that was ever in the map.
    """

    def __init__(self, model: Any):
        self.model = model
        self.count = len(model)
        self._groups: list[_Group] = []
        self.events: list[Event] = []
        self._final: Int[Tensor, " N"] | None = None
        if self.count:
            first = {"first": 0, "cause": "before the trace", "frame_index": None, "step": 0, "rule": ""}
            self._groups.append(_Group(**first, tag=model.tag.cpu().clone()))
        model.trace_ids()[:] = torch.arange(1, self.count + 1, device=model.device)

    def now(self) -> Int[Tensor, " N"]:
        """Identity of each row, on the CPU; after ``close`` as it was then."""
        if self._final is not None:
            return self._final
        return self.model.trace_ids().long().cpu() - 1

    def row_of(self, i: int) -> int | None:
        """The row of a Gaussian now; ``None`` if it has left the map."""
        rows = (self.now() == i).nonzero()[:, 0]
        return int(rows[0]) if len(rows) else None

    def birth(self, i: int) -> Birth:
        """How a Gaussian came into the map. Raises ``IndexError`` for a number that no Gaussian has."""
        if not 0 <= i < self.count:
            raise IndexError(f"no Gaussian has the number {i}; there have been {self.count}")
        group = next(g for g in reversed(self._groups) if g.first <= i)
        birth = group.birth(i)
        return self._birth_before(birth) if birth.cause == "before the trace" else birth

    def of(self, i: int) -> list[Event]:
        """What happened to a Gaussian besides optimisation, in order."""
        return [event for event in self.events if i in event.ids]

    def mark(self) -> tuple[int, int, int]:
        """The state, for ``go_back``."""
        return self.count, len(self._groups), len(self.events)

    def go_back(self, mark: tuple[int, int, int]) -> None:
        """Forget what came after ``mark``."""
        self.count = mark[0]
        del self._groups[mark[1] :]
        del self.events[mark[2] :]

    def appended(self, n: int, cause: str, frame_index: int | None, rule: str, more: dict[str, Any]) -> None:
        """Number the last ``n`` rows."""
        if not n:
            return
        start, model = len(self.model) - n, self.model
        tag = model.tag[start:].cpu().clone()
        group = _Group(
            first=self.count, cause=cause, frame_index=frame_index, step=model.step_count, rule=rule, tag=tag, **more
        )
        self._groups.append(group)
        model.trace_ids()[start:] = torch.arange(self.count + 1, self.count + n + 1, device=model.device)
        self.count += n

    def copied(self, copies: Int[Tensor, " C"], cause: str, frame_index: int | None, rule: str) -> None:
        """Number rows that are copies and still have the number of the Gaussian that they are a copy of."""
        if not len(copies):
            return
        ids = self.model.trace_ids()
        parent = ids[copies].long().cpu() - 1
        self._groups.append(
            _Group(
                first=self.count, cause=cause, frame_index=frame_index, step=self.model.step_count, rule=rule,
                tag=self.model.tag[copies].cpu().clone(), parent=parent,
            )
        )  # fmt: skip
        ids[copies] = torch.arange(self.count + 1, self.count + len(copies) + 1, device=ids.device).to(ids)
        self.count += len(copies)

    def ended(self, before: Int[Tensor, " N"], after: Int[Tensor, " M"], why: str, numbers: dict[str, Any]) -> None:
        """Note the Gaussians that are in ``before`` and not in ``after``."""
        gone = before[~torch.isin(before, after)]
        self._note(why, gone, numbers, ends=True)

    def edited(
        self,
        edit: Edit,
        ids: Int[Tensor, " N"],
        count: int,
        origin: Int[Tensor, " M"],
        numbers: dict[str, Any],
        rule: str,
    ) -> None:
        """Number the rows that an edit copied, and note what it did to the others.

        Args:
            edit: With row numbers.
            ids: Identity of each row before it.
            count: Gaussians that there had been before it; those that it added are numbered already.
            origin: Row before of each row now, -1 for new ones.
            numbers: ``serial`` and ``frame_index``.
            rule: Name of the seeding rule.
        """
        now, split = self.now(), torch.zeros(0, dtype=torch.int64) if edit.split is None else edit.split.cpu()
        copies = ((origin.cpu() < 0) & (now < count)).nonzero()[:, 0]
        halves = torch.isin(now[copies], ids[split])
        frame_index = numbers["frame_index"]
        self.copied(copies[~halves], "clone", frame_index, rule)
        self.copied(copies[halves], "split", frame_index, rule)
        if edit.set:
            changed = torch.cat([rows.cpu() for rows, _ in edit.set.values()]).unique()
            self._note(f"{', '.join(edit.set)} set by the rule", ids[changed], numbers)
        if edit.reset_opacity is not None:
            self._note(f"opacity at most {edit.reset_opacity:g}", ids, numbers)
        if edit.relocate is not None:
            moved, target = (ids[rows.cpu()] for rows in edit.relocate)
            self._note("relocated to a copy of Gaussian", moved, numbers, others=target)
            self._note("shares its place with Gaussian", target, numbers, others=moved)
        if edit.clone is not None:
            self._note("cloned", ids[edit.clone.cpu()].unique(), numbers)
        self._note("split in two", ids[split], numbers, ends=True)
        kept = torch.cat([self.now(), ids[split]])
        self.ended(ids, kept, "removed by the rule", numbers)

    def close(self) -> None:
        """Forget the rows' numbers; births and events stay known."""
        self._final = self.now()
        self.model.end_trace()

    def _note(
        self, what: str, ids: Tensor, numbers: dict[str, Any], *, others: Tensor | None = None, ends: bool = False
    ) -> None:
        if len(ids):
            partners = () if others is None else tuple(others.tolist())
            self.events.append(Event(**numbers, what=what, ids=tuple(ids.tolist()), others=partners, ends=ends))

    def _birth_before(self, birth: Birth) -> Birth:
        row = self.row_of(birth.id)
        frame = None if row is None else int(self.model.birth_frame[row])
        return Birth(**{**vars(birth), "frame_index": frame})


def origin_of(record: SeedingRecord, seeds: Seeds) -> dict[str, Any]:
    """Where each of n seeds comes from: the pixel [n, 2], the quadtree leaf around it [n, 5] (width 0: none), and W of
    its voxel [n] (NaN: not asked).

    A seed belongs to the pixel to which its centre projects.
    """
    camera, xyz_W = record.frame.camera, seeds.xyz_W.cpu()
    uv = project(camera, se3.apply(se3.inverse(record.frame.T_WC.cpu().double()), xyz_W.double())).float()
    origin: dict[str, Any] = {"uv": uv}
    if record.cells is not None:
        origin["cell"] = _cells_around(record.cells, camera, uv)
    if record.asked_xyz_W is not None and record.asked_W is not None and len(record.asked_xyz_W):
        origin["voxel_W"] = _asked(record.asked_xyz_W.cpu(), record.asked_W.cpu(), xyz_W)
    return origin


def _cells_around(cells: Any, camera: Camera, uv: Float[Tensor, "n 2"]) -> Int[Tensor, "n 5"]:
    owner = torch.full((camera.height, camera.width), -1, dtype=torch.int64)
    columns = [getattr(cells, name).cpu() for name in ("x0", "y0", "width", "height", "level")]
    table = torch.stack([*columns], dim=1).long()
    for k, (x, y, w, h, _) in enumerate(table.tolist()):
        owner[y : y + h, x : x + w] = k
    i, j = uv.floor().long().unbind(1)
    inside = (i >= 0) & (i < camera.width) & (j >= 0) & (j < camera.height)
    at = torch.where(inside, owner[j.clamp(0, camera.height - 1), i.clamp(0, camera.width - 1)], -1)
    return torch.where((at >= 0)[:, None], table[at.clamp(min=0)], 0)


def _asked(asked_xyz: Tensor, asked_W: Tensor, xyz: Tensor) -> Float[Tensor, " n"]:
    """W of the points that are among those asked for, NaN for others."""
    keys, inverse = torch.unique(torch.cat([asked_xyz, xyz]), dim=0, return_inverse=True)
    known = torch.full((len(keys),), torch.nan)
    known[inverse[: len(asked_xyz)]] = asked_W.float()
    return known[inverse[len(asked_xyz) :]]
