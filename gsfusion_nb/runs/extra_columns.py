"""What each Gaussian shows of the further images of the frames (``Frame.extra``): the label of most
of its pixels, or the mean of an image there.

A pixel p counts for a Gaussian k with its blending weight w(k, p) there. Of a label c the share of
the Gaussian is

    s(k, c) = sum_p w(k, p) [label(p) = c] / sum_p w(k, p)

over the pixels of all frames, and the mean of an image f is sum_p w(k, p) f(p) / sum_p w(k, p).
Such sums are the gradient of a blended picture with respect to its colours: a frame takes one
``render_forward``, and a ``render_vjp`` for three of them.
"""

import dataclasses
import itertools
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Shaped
from torch import Tensor

from ..errors import ArgumentError
from ..files import atomic_file
from ..geometry.spherical_harmonics import SH_C0
from ..render import render_forward, render_vjp
from ..render.constants import NEAR_PLANE_M
from ..render.near_plane import near_plane_m
from ..types import Frame, GaussianParams
from .mapping_run import MappingRun
from .poses_in_map import frames_in_map

EXTRA_COLUMNS = "extra.npz"
MOST_VIEWS = 200
"""Mapped frames of a run that are looked at, evenly spread."""
MOST_LABELS = 256
"""Different labels of an image: while they are counted, each has a number for each Gaussian."""
SEEN = "seen_px"
"""Name of the column that says how much of each Gaussian the frames show."""


def extra_columns(
    params: GaussianParams, frames: Iterable[Frame], near_m: float = NEAR_PLANE_M
) -> dict[str, Shaped[np.ndarray, "N *C"]]:
    """Columns of Gaussians from the further images of frames.

    Labels are whole numbers or truth values [H, W]. Their column is the label with the largest
    share, and the column ``NAME_share`` that share, 0..1. Of any other image [H, W, ...] the column
    is the mean [N, ...]. ``seen_px`` is the sum of the weights, in pixels: where it is 0 no frame
    shows the Gaussian, and its other columns are 0.

    Args:
        params: The map, whose Gaussians are blended as in ``render``. [N] rows
        frames: With their poses in the map. All must have the same further images.
        near_m: Nearer Gaussians are not drawn, metres.

    Returns:
        Name -> column; empty if the frames have no further images.

    Raises:
        ValueError: an image has more than ``MOST_LABELS`` labels, or the name of another column.
        KeyError: a frame lacks an image that the first has.
    """
    sums = dict[str, _LabelSums | _ImageSums]()
    seen_px = torch.zeros(len(params), dtype=torch.float64)
    # no harmonics, and no channel at 0, where colours are cut
    grey = dataclasses.replace(params, sh=torch.zeros_like(params.sh[:, :1]))
    for frame in frames:
        moved = frame.to(params.xyz_W.device)
        if not sums:
            sums = {name: _sums_of(name, image, params) for name, image in moved.extra.items()}
            _check_names(sums)
            if not sums:
                return {}
        planes = {name: one.planes(moved.extra[name]) for name, one in sums.items()}
        _, record = render_forward(grey, moved.camera, moved.T_WC, near_m=near_m)
        everywhere = moved.depth_m.new_ones(moved.depth_m.shape)
        weights = _weight_sums(record, itertools.chain([everywhere], *planes.values()))
        seen_px += next(weights)
        for one in sums.values():
            one.add(weights)
    columns = dict[str, Tensor]()
    for one in sums.values():
        columns |= one.columns(seen_px)
    columns |= {SEEN: seen_px.float()} if sums else {}
    return {name: column.numpy() for name, column in columns.items()}


def write_extra_columns(run: MappingRun, folder: Path) -> None:
    """Write ``extra.npz`` beside ``gaussians.ply``, row for row, if the mapped frames have further
    images; a warning of the run says why there is none, if they cannot become columns."""
    view = run.views.sample(MOST_VIEWS)
    frames = frames_in_map(view, run.mapper.localiser, run.sequence.mapping)
    first = next(frames, None)
    if first is None or not first.extra:
        return
    if run.mapper.description.needs_volume_to_render:
        run.warnings.note_ending(
            f"no {EXTRA_COLUMNS}: {run.mapper.description.title} draws its Gaussians over a "
            "surface, so what a pixel shows is not that of Gaussians alone"
        )
        return
    params = run.mapper.parts.params_now()
    try:
        near_m = near_plane_m(run.mapper.config)
        columns: dict[str, Any] = extra_columns(params, itertools.chain([first], frames), near_m)
    except (ArgumentError, KeyError) as e:
        run.warnings.note_ending(f"no {EXTRA_COLUMNS}: {e}")
        return
    with atomic_file(folder / EXTRA_COLUMNS) as temporary, temporary.open("wb") as file:
        np.savez_compressed(file, **columns)


class _LabelSums:
    """The weights that each Gaussian has in the pixels of each label."""

    def __init__(self, name: str, n: int):
        self.name = name
        self._column_of = dict[int, int]()
        """Label -> its column of ``_sums``."""
        self._sums = torch.zeros(n, 0, dtype=torch.float64)
        self._labels_of_frame: list[int] = []

    @property
    def names(self) -> list[str]:
        """Of its columns."""
        return [self.name, f"{self.name}_share"]

    def planes(self, image: Shaped[Tensor, "H W"]) -> Iterator[Float[Tensor, "H W"]]:
        """1 where the image has a label, for each label in it."""
        self._labels_of_frame = [int(label) for label in image.unique().tolist()]
        for label in self._labels_of_frame:
            self._column_of.setdefault(label, len(self._column_of))
        if len(self._column_of) > MOST_LABELS:
            raise ArgumentError(
                f"the labels {self.name!r} have more than {MOST_LABELS} values; give others as "
                "floats, of which each Gaussian gets the mean"
            )
        n_new = len(self._column_of) - self._sums.shape[1]
        self._sums = torch.nn.functional.pad(self._sums, (0, n_new))
        return ((image == label).float() for label in self._labels_of_frame)

    def add(self, weights: Iterator[Float[Tensor, " N"]]) -> None:
        """Take the sums of the planes of a frame, in their order."""
        for label in self._labels_of_frame:
            self._sums[:, self._column_of[label]] += next(weights)

    def columns(self, seen_px: Float[Tensor, " N"]) -> dict[str, Tensor]:
        """The label of each Gaussian, and its share."""
        most, place = self._sums.max(dim=1)
        labels = torch.tensor(list(self._column_of))[place]
        is_seen = seen_px > 0
        share = torch.where(is_seen, most / seen_px, 0.0).float()
        return dict(zip(self.names, (labels * is_seen, share), strict=True))


class _ImageSums:
    """The sum of an image over the pixels of each Gaussian, by their weights."""

    def __init__(self, name: str, n: int, shape: tuple[int, ...]):
        self.name = name
        self._shape = shape
        """Of a pixel."""
        self._sums = torch.zeros(n, *shape, dtype=torch.float64).reshape(n, -1)

    @property
    def names(self) -> list[str]:
        """Of its columns."""
        return [self.name]

    def planes(self, image: Shaped[Tensor, "H W *C"]) -> Iterator[Float[Tensor, "H W"]]:
        """The channels of the image."""
        if tuple(image.shape[2:]) != self._shape:
            raise ArgumentError(
                f"the image {self.name!r} has pixels {list(image.shape[2:])} in a frame and "
                f"{list(self._shape)} in another"
            )
        return iter(image.reshape(*image.shape[:2], -1).float().unbind(2))

    def add(self, weights: Iterator[Float[Tensor, " N"]]) -> None:
        """Take the sums of the channels of a frame, in their order."""
        for i in range(self._sums.shape[1]):
            self._sums[:, i] += next(weights)

    def columns(self, seen_px: Float[Tensor, " N"]) -> dict[str, Tensor]:
        """The mean of the image in the pixels of each Gaussian."""
        mean = torch.where(seen_px[:, None] > 0, self._sums / seen_px[:, None], 0.0)
        return {self.name: mean.float().reshape(-1, *self._shape)}


def _sums_of(name: str, image: Tensor, params: GaussianParams) -> _LabelSums | _ImageSums:
    if image.ndim == 2 and not image.is_floating_point():
        return _LabelSums(name, len(params))
    return _ImageSums(name, len(params), tuple(image.shape[2:]))


def _check_names(sums: dict[str, "_LabelSums | _ImageSums"]) -> None:
    """Raise ``ValueError`` if two columns would have the same name."""
    names = [SEEN, *(name for one in sums.values() for name in one.names)]
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise ArgumentError(
            f"a further image cannot be named {twice[0]!r}, which is a column of another; rename it"
        )


def _weight_sums(
    record: Any, planes: Iterator[Float[Tensor, "H W"]]
) -> Iterator[Float[Tensor, " N"]]:
    """For each plane, the sum of its pixels times the weights of each Gaussian in them; on the
    CPU, in float64."""
    while three := list(itertools.islice(planes, 3)):
        missing = [torch.zeros_like(three[0])] * (3 - len(three))
        v = render_vjp(record, torch.stack([*three, *missing], dim=2))
        yield from (v.sh[:, 0] / SH_C0).double().cpu().unbind(1)[: len(three)]
