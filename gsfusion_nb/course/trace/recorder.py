"""The observer of one mapper: the operations that it runs are turned into records, without changing
them."""

from collections.abc import Callable
from typing import Any, Literal

import torch
from torch import Tensor

from ...geometry import se3
from ...large_maps import MapPart
from ...seeding import rule_name
from ...tsdf.integrate import blocks_in_view
from .identity import Identities, origin_of
from .operations import AdamColumn, FusionRecord, Record, SeedingRecord, StepRecord

Call = Callable[..., Any]


class Recorder:
    """The observer of one mapper (``gsfusion_nb.backends``).

    Args:
        mapper: What is observed.
        identities: Of the rows of its map.
        add: Takes each record.
    """

    def __init__(
        self,
        mapper: Any,
        identities: Identities,
        add: Callable[[Record], None],
    ):
        self.mapper = mapper
        self.identities = identities
        self._add = add
        self.serial = 0
        self._last: dict[str, list[Tensor]] = {}
        self._handlers = {
            "quadtree": self._quadtree,
            "apply_rule": self._apply_rule,
            "GaussianModel.append": self._append,
            "apply_edit": self._apply_edit,
            "GSFusion._optimise_view": self._optimise_view,
            "render_forward": self._render_forward,
            "adam_step": self._adam_step,
            "adam_update_map": self._adam_update_map,
            "fuse_frame_": self._fuse_frame,
        }
        self.begin(None)

    def __call__(
        self,
        name: str,
        f: Call,
        args: tuple[Any, ...],
        kwargs: dict[str, Any],
    ) -> Any:
        """Run ``f`` and record what it did."""
        handler = self._handlers.get(name)
        return f(*args, **kwargs) if handler is None else handler(f, args, kwargs)

    def begin(self, frame_index: int | None) -> None:
        """A frame begins, or a step after the scan."""
        self.frame_index = frame_index
        self._cells: Any = None
        self._step: dict[str, Any] | None = None
        self._seeding: SeedingRecord | None = None
        self._editing = False

    def _next(self) -> dict[str, Any]:
        self.serial += 1
        return {"serial": self.serial - 1, "frame_index": self.frame_index}

    def _quadtree(self, f: Call, args: tuple, kwargs: dict) -> Any:
        self._cells = cells = f(*args, **kwargs)
        return cells

    def _apply_rule(self, f: Call, args: tuple, kwargs: dict) -> Any:
        self._cells = None
        seeds = f(*args, **kwargs)
        self._seeding = SeedingRecord(
            **self._next(),
            frame=args[1].frame,
            cells=self._cells,
            seeds=seeds,
        )
        self._add(self._seeding)
        return seeds

    def _append(self, f: Call, args: tuple, kwargs: dict) -> Any:
        model, seeds = args[:2]
        if model is not self.identities.model:
            return f(*args, **kwargs)
        n_old = len(model)
        result = f(*args, **kwargs)
        seeding = self._seeding
        own = {}
        if seeding is not None and seeding.seeds is seeds and len(seeds) > 0:
            own = origin_of(seeding.frame, seeding.cells, seeds)
        rule = rule_name(self.mapper.rule)
        cause = "added by the rule" if self._editing else "seed"
        self.identities.number(
            torch.arange(n_old, len(model)), cause, self.frame_index, rule, **own
        )
        return result

    def _apply_edit(self, f: Call, args: tuple, kwargs: dict) -> Any:
        model, edit = args[:2]
        if model is not self.identities.model:
            return f(*args, **kwargs)
        plain = edit.resolved(model.params.sh, "state" in model.columns)
        ids = self.identities.now()
        count = self.identities.count
        self._editing = True
        try:
            origin = f(*args, **kwargs)
        finally:
            self._editing = False
        self.identities.edited(
            plain,
            ids,
            count,
            origin,
            self._next(),
            rule_name(self.mapper.rule),
        )
        return origin

    def _optimise_view(self, f: Call, args: tuple, kwargs: dict) -> Any:
        mapper, view = args[:2]
        if mapper is not self.mapper:
            return f(*args, **kwargs)
        ids = self.identities.now()
        self._step = step = {
            "ids": ids,
            "rows": torch.arange(len(ids)),
            "rates": {},
            "t": None,
        } | self._next()
        view_step = f(*args, **kwargs)
        self._step = None
        if "screen" in step and "adam" in step:
            self._add(
                StepRecord(
                    stage=self._stage(view.index),
                    view_index=view.index,
                    loss=view_step.loss,
                    **step,
                )
            )
        return view_step

    def _stage(self, view_index: int) -> Literal["frame", "keyframe", "passes"]:
        """When a view is optimised: as the present frame, as an earlier keyframe, or after the
        scan."""
        if self.frame_index is None:
            return "passes"
        return "frame" if view_index == self.frame_index else "keyframe"

    def _render_forward(self, f: Call, args: tuple, kwargs: dict) -> Any:
        output, context = f(*args, **kwargs)
        if self._step is not None and "screen" not in self._step:
            self._step |= {"screen": context.screen, "rgb": output.rgb, "camera": args[1]}
        return output, context

    def _adam_step(self, f: Call, args: tuple, kwargs: dict) -> Any:
        part, gradients = args[:2]
        if (
            self._step is None
            or not isinstance(part, MapPart)
            or part.model is not self.mapper.gaussians
        ):
            return f(*args, **kwargs)
        rows = torch.arange(len(part.model), device=part.model.device)[part.rows].cpu()
        self._step |= {"rows": rows, "ids": self._step["ids"][rows]}
        old = _copies(part)
        for (
            name,
            last,
        ) in self._last.items():  # what did not change since the last step is held once
            old[name] = [
                b if torch.equal(a, b) else a for a, b in zip(old[name], last, strict=True)
            ]
        result = f(*args, **kwargs)
        self._last = new = _copies(part)
        self._step["adam"] = columns = {}
        rates = self._step.pop("rates")
        for name, gradient in vars(gradients).items():
            p0, m0, v0 = old[name]
            p1, m1, v1 = new[name]
            lr = rates.get(name, float("nan"))  # NaN: another function than Adam takes the step
            columns[name] = AdamColumn(
                before=p0,
                gradient=gradient,
                m=(m0, m1),
                v=(v0, v1),
                after=p1,
                lr=lr,
            )
        return result

    def _adam_update_map(self, f: Call, args: tuple, kwargs: dict) -> Any:
        if self._step is not None:
            t = args[4]
            self._step["rates"] = kwargs["rates"].by_column(args[0].sh)
            self._step["t"] = t.clone() if isinstance(t, Tensor) else t
        return f(*args, **kwargs)

    def _fuse_frame(self, f: Call, args: tuple, kwargs: dict) -> Any:
        volume, frame = args[:2]
        if volume is not getattr(self.mapper, "volume", None):
            return f(*args, **kwargs)
        rows = blocks_in_view(volume, frame.camera, se3.inverse(frame.T_WC.double()))
        D = volume.D[rows]
        W = volume.W[rows]
        result = f(*args, **kwargs)
        self._add(
            FusionRecord(
                **self._next(),
                frame=frame,
                config=volume.config,
                coords=volume.block_coords[rows].clone(),
                D=(D, volume.D[rows]),
                W=(W, volume.W[rows]),
            )
        )
        return result


def _copies(part: MapPart) -> dict[str, list[Tensor]]:
    """Parameter -> copies of its values, of m and of v."""
    groups = (part.params, part.moments.exp_avg, part.moments.exp_avg_sq)
    return {name: [getattr(group, name).clone() for group in groups] for name in vars(part.params)}
