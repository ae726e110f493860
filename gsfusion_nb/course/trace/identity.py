"""Which Gaussian is in which row: every Gaussian has a number of its own from its birth to its
end."""

from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from ...gaussians import Edit
from ...geometry import project, se3
from ...types import Camera, Frame, Seeds


def when(frame_index: int | None) -> str:
    """The frame in words; ``None``: one of the passes after the scan."""
    return "after the scan" if frame_index is None else f"frame {frame_index}"


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
    """Quadtree leaf around that pixel: first column, first row, width, height, level. ``None``
    without a quadtree."""
    parent: int | None = None
    """Identity of the Gaussian that it is a copy or a half of."""
    tag: int = 0
    """Label that the rule gave it."""

    def __str__(self) -> str:
        where = "" if self.frame_index is None else f" in frame {self.frame_index}"
        words = [f"{self.cause}{where}"]
        if self.rule:
            words.append(f"rule {self.rule}")
        if self.parent is not None:
            words.append(f"of Gaussian {self.parent}")
        if self.uv:
            u, v = self.uv
            words.append(f"pixel ({u:.1f}, {v:.1f})")
        if self.cell:
            x, y, w, h, level = self.cell
            words.append(f"quadtree cell {w} x {h} px at ({x}, {y}), level {level}")
        return ", ".join(words)


@dataclass(frozen=True, kw_only=True)
class Event:
    """A change of rows between two optimisation steps, or the end of a Gaussian."""

    serial: int
    frame_index: int | None
    what: str
    """"removed", "split", "cloned", "relocated", "set", ..."""
    ids: tuple[int, ...]

    def __str__(self) -> str:
        return f"{when(self.frame_index)}: {self.what}"


class Identities:
    """The identities of the rows of one map. They move with the rows, in a column that no one else
    uses.

    Memory: about 60 bytes for each Gaussian that was ever in the map.
    """

    def __init__(self, model: Any):
        self.model = model
        self.count = 0
        self._births: list[tuple[int, dict[str, Any], dict[str, Tensor]]] = []
        """Of Gaussians with consecutive numbers: the first number, what they share, and what each
        has of its own."""
        self.events: list[Event] = []
        self._final: Int[Tensor, " N"] | None = None
        model.traces.use("id")  # from now on the map has the column, also while it is empty
        self.number(torch.arange(len(model)), "before the trace", None, "")

    def now(self) -> Int[Tensor, " N"]:
        """Identity of each row, on the CPU; after ``close`` as it was then."""
        if self._final is not None:
            return self._final
        return self.model.traces.use("id").long().cpu() - 1

    def row_of(self, i: int) -> int | None:
        """The row of a Gaussian now; ``None`` if it has left the map."""
        rows = (self.now() == i).nonzero()[:, 0]
        return int(rows[0]) if len(rows) else None

    def birth(self, i: int) -> Birth:
        """How a Gaussian came into the map. Raises ``IndexError`` for a number that no Gaussian
        has."""
        if not 0 <= i < self.count:
            raise IndexError(f"no Gaussian has the number {i}; there have been {self.count}")
        first, fields, columns = next(births for births in reversed(self._births) if births[0] <= i)
        own: dict[str, Any] = {name: column[i - first].tolist() for name, column in columns.items()}
        own |= {name: tuple(values) for name, values in own.items() if isinstance(values, list)}
        if "cell" in own and own["cell"][2] == 0:
            own["cell"] = None
        if fields["cause"] == "before the trace" and (row := self.row_of(i)) is not None:
            own["frame_index"] = int(self.model.birth_frame[row])
        return Birth(id=i, **fields | own)

    def of(self, i: int) -> list[Event]:
        """What happened to a Gaussian besides optimisation, in order."""
        return [event for event in self.events if i in event.ids]

    def number(
        self,
        rows: Int[Tensor, " n"],
        cause: str,
        frame_index: int | None,
        rule: str,
        **own: Tensor,
    ) -> None:
        """Give rows that are new, or copies, numbers of their own; ``own``: fields of ``Birth``, a
        row of each."""
        if not len(rows):
            return
        ids = self.model.traces.use("id")
        tag = self.model.tag[rows].cpu().clone()
        fields = {
            "cause": cause,
            "frame_index": frame_index,
            "rule": rule,
            "step": self.model.clock.count,
        }
        self._births.append((self.count, fields, {"tag": tag, **own}))
        ids[rows] = torch.arange(
            self.count + 1,
            self.count + len(rows) + 1,
            device=ids.device,
        ).to(ids)
        self.count += len(rows)

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
            count: Gaussians that there had been before it; those that it added are numbered
                already.
            origin: Row before of each row now, -1 for new ones.
            numbers: ``serial`` and ``frame_index``.
            rule: Name of the seeding rule.
        """
        ids_now = self.now()
        parents = torch.zeros(0, dtype=torch.int64) if edit.split is None else edit.split.cpu()
        copies = ((origin.cpu() < 0) & (ids_now < count)).nonzero()[:, 0]
        halves = torch.isin(ids_now[copies], ids[parents])
        for rows, cause in ((copies[~halves], "clone"), (copies[halves], "split")):
            self.number(rows, cause, numbers["frame_index"], rule, parent=ids_now[rows])
        survives = torch.isin(ids, self.now())
        survives[parents] = True
        events = [("split in two", ids[parents]), ("removed by the rule", ids[~survives])]
        events += [
            (f"{name} set by the rule", ids[rows.cpu()])
            for name, (rows, _) in (edit.set or {}).items()
        ]
        if edit.reset_opacity is not None:
            events.append((f"opacity at most {edit.reset_opacity:g}", ids))
        if edit.relocate is not None:
            events.append(("relocated to a copy of another", ids[edit.relocate[0].cpu()]))
        if edit.clone is not None:
            events.append(("cloned", ids[edit.clone.cpu()].unique()))
        self.events += [
            Event(**numbers, what=what, ids=tuple(of.tolist())) for what, of in events if len(of)
        ]

    def close(self) -> None:
        """Forget the rows' numbers; births and events stay known."""
        self._final = self.now()
        self.model.traces.remove("id")


def origin_of(frame: Frame, cells: Any, seeds: Seeds) -> dict[str, Tensor]:
    """Where each of n seeds of a frame comes from: the pixel ``uv`` [n, 2], and the quadtree leaf
    around it, ``cell`` [n, 5] (width 0: none).

    A seed belongs to the pixel to which its centre projects.
    """
    T_CW = se3.inverse(frame.T_WC.cpu().double())
    uv = project(
        frame.camera,
        se3.apply(T_CW, seeds.xyz_W.cpu().double()),
    ).float()
    return (
        {"uv": uv} if cells is None else {"uv": uv, "cell": _cells_around(cells, frame.camera, uv)}
    )


def _cells_around(
    cells: Any,
    camera: Camera,
    uv: Float[Tensor, "n 2"],
) -> Int[Tensor, "n 5"]:
    owner = torch.full(
        (camera.height, camera.width),
        -1,
        dtype=torch.int64,
    )
    columns = [getattr(cells, name).cpu() for name in ("x0", "y0", "width", "height", "level")]
    table = torch.stack([*columns], dim=1).long()
    for k, (x, y, w, h, _) in enumerate(table.tolist()):
        owner[y : y + h, x : x + w] = k
    i, j = uv.floor().long().unbind(1)
    in_image = (i >= 0) & (i < camera.width) & (j >= 0) & (j < camera.height)
    at = torch.where(
        in_image,
        owner[j.clamp(0, camera.height - 1), i.clamp(0, camera.width - 1)],
        -1,
    )
    return torch.where(
        (at >= 0)[:, None],
        table[at.clamp(min=0)],
        0,
    )
