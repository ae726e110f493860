"""What finds a camera again in a map: its keyframes' poses and features, in a run's folder the file
``places.npz``.

A compressed NumPy archive: ``camera`` [6] float64 (width, height, fx, fy, cx, cy), and for the K
keyframes ``index`` [K] int64, ``T_WC`` [K, 4, 4] float64 and ``n_features`` [K] int64. Of the N
features, keyframe by keyframe: ``uv`` [N, 2] and ``sigma_px`` [N] float32, ``descriptors`` [N, 32]
uint8, ``xyz_C`` [N, 3] float32 and ``has_depth`` [N] bool, as in ``Features``. A keyframe takes
about 45 kB. Landmarks are not in it: they are tracked again over the keyframes when it is read.
"""

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ..checks import SAVED_RIGIDITY_ERROR, check_pose
from ..errors import SequenceError
from ..files import atomic_file, open_arrays, parsing
from ..types import Camera
from .features import DESCRIPTOR_BYTES, Features
from .keyframe_database import KeyframeDatabase
from .landmark_map import LandmarkMap

PLACES = "places.npz"
"""The file in a run's folder."""

_WHAT = "the places of a run, written by write_places"
_CAMERA = ("width", "height", "fx", "fy", "cx", "cy")
_ARRAYS: dict[str, tuple[str, tuple[str | int, ...]]] = {
    "camera": ("<f8", (6,)),
    "index": ("<i8", ("K",)),
    "T_WC": ("<f8", ("K", 4, 4)),
    "n_features": ("<i8", ("K",)),
    "uv": ("<f4", ("N", 2)),
    "descriptors": ("u1", ("N", DESCRIPTOR_BYTES)),
    "xyz_C": ("<f4", ("N", 3)),
    "has_depth": ("?", ("N",)),
    "sigma_px": ("<f4", ("N",)),
}
"""Type and shape of each array: K keyframes, N features."""
_OF_FEATURES = ("uv", "descriptors", "xyz_C", "has_depth", "sigma_px")


@dataclass(frozen=True, kw_only=True, eq=False)
class Places:
    """Keyframes by pose and appearance."""

    camera: Camera
    """Intrinsics of all keyframes."""
    index: list[int]
    """Frame index of each keyframe."""
    T_WC: Float[Tensor, "K 4 4"]
    """Camera-to-world poses, float64."""
    features: list[Features]
    """Features of each keyframe."""

    def __len__(self) -> int:
        return len(self.index)

    @staticmethod
    def of(database: KeyframeDatabase, T_WC: Float[Tensor, "K 4 4"] | None = None) -> "Places":
        """The keyframes of a database; ``T_WC`` are their poses, if they are others by now."""
        poses = database.T_WC if T_WC is None else list(T_WC.detach().cpu().double())
        return Places(
            camera=database.camera,
            index=list(database.index),
            T_WC=torch.stack(poses) if poses else torch.zeros(0, 4, 4, dtype=torch.float64),
            features=list(database.features),
        )

    def seen_by(self, camera: Camera) -> "Places":
        """The same keyframes with their pixels as another camera would have seen them, along the
        same rays.

        A recording of another camera, or of another size, can then be compared with them.
        """
        if camera == self.camera:
            return self
        old = self.camera
        ratio = torch.tensor([camera.fx / old.fx, camera.fy / old.fy])
        old_centre = torch.tensor([old.cx, old.cy])
        centre = torch.tensor([camera.cx, camera.cy])
        features = [
            dataclasses.replace(
                f,
                uv=(f.uv - old_centre) * ratio + centre,
                sigma_px=f.sigma_px * float(ratio.mean()),
            )
            for f in self.features
        ]
        return dataclasses.replace(self, camera=camera, features=features)

    def counted_back(self, shift: int) -> "Places":
        """The same keyframes with ``shift`` taken from their frame indices."""
        return dataclasses.replace(self, index=[index - shift for index in self.index])

    def database(self) -> KeyframeDatabase:
        """The keyframes by appearance."""
        database = KeyframeDatabase(self.camera)
        for index, T_WC, features in zip(self.index, self.T_WC, self.features, strict=True):
            database.add(index, T_WC, features)
        return database

    def landmark_map(self, camera: Camera | None = None) -> LandmarkMap:
        """Keyframes and the landmarks that they share, for views of a camera (default: their
        own)."""
        seen = self.seen_by(camera or self.camera)
        landmarks = LandmarkMap(seen.camera)
        for index, T_WC, features in zip(seen.index, seen.T_WC, seen.features, strict=True):
            landmarks.add(index, T_WC, features)
        return landmarks


def write_places(path: str | Path, places: Places) -> None:
    """Write keyframes and their features, atomically."""
    columns: dict[str, Any] = {
        "camera": [getattr(places.camera, name) for name in _CAMERA],
        "index": places.index,
        "T_WC": places.T_WC.numpy(),
        "n_features": [len(f) for f in places.features],
    }
    for name in _OF_FEATURES:
        kind, (_, *others) = _ARRAYS[name]
        none = np.zeros([0, *map(int, others)], kind)
        rows = [getattr(f, name).numpy() for f in places.features]
        columns[name] = np.concatenate([none, *rows])
    columns["xyz_C"] = np.where(columns["has_depth"][:, None], columns["xyz_C"], 0)
    arrays: dict[str, Any] = {
        name: np.asarray(columns[name], kind) for name, (kind, _) in _ARRAYS.items()
    }
    with atomic_file(path) as temporary, temporary.open("wb") as file:
        np.savez_compressed(file, **arrays)


def read_places(path: str | Path) -> Places:
    """The keyframes that ``write_places`` wrote.

    Raises:
        FileNotFoundError: no such file. ValueError: another file, or a damaged one.
    """
    path = Path(path)
    with open_arrays(path, _WHAT) as archive:
        arrays = _arrays_of(path, archive)
    with parsing(path, _WHAT):
        width, height, *others = arrays["camera"].tolist()
        if not (width.is_integer() and height.is_integer()):
            raise SequenceError(f"{path}: the size of the camera is {width:g} x {height:g} pixels")
        camera = Camera(
            width=int(width),
            height=int(height),
            **dict(zip(_CAMERA[2:], others, strict=True)),
        )
    _check_values(path, arrays, camera)
    ends = np.cumsum(arrays["n_features"])
    features = [
        Features(**{name: torch.from_numpy(arrays[name][end - n : end]) for name in _OF_FEATURES})
        for end, n in zip(ends.tolist(), arrays["n_features"].tolist(), strict=True)
    ]
    return Places(
        camera=camera,
        index=arrays["index"].tolist(),
        T_WC=torch.from_numpy(arrays["T_WC"]),
        features=features,
    )


def _arrays_of(path: Path, archive: Any) -> dict[str, np.ndarray]:
    """The arrays, each of the expected type and of sizes that agree."""
    arrays: dict[str, np.ndarray] = {}
    sizes: dict[str, int] = {}
    for name, (kind, shape) in _ARRAYS.items():
        if name not in archive.files:
            raise SequenceError(f"{path} has no array {name}; expected {_WHAT}")
        array = archive[name]
        expected_sizes: tuple[Any, ...] = shape
        fits = len(shape) == array.ndim and array.dtype == np.dtype(kind)
        if fits:
            expected_sizes = tuple(
                sizes.setdefault(axis, size) if isinstance(axis, str) else axis
                for axis, size in zip(shape, array.shape, strict=True)
            )
        if not fits or array.shape != expected_sizes:
            raise SequenceError(
                f"{path}: {name} is {list(array.shape)} of {array.dtype}, expected "
                f"{list(expected_sizes)} of {np.dtype(kind)}; expected {_WHAT}"
            )
        arrays[name] = array
    return arrays


def _check_values(path: Path, arrays: dict[str, np.ndarray], camera: Camera) -> None:
    """Raise ``SequenceError`` for values that no run writes."""
    counts = arrays["n_features"]
    n = len(arrays["uv"])
    if (counts < 0).any() or (counts > n).any() or int(counts.sum()) != n:
        raise SequenceError(f"{path} has {n} features, but its keyframes do not add up to them")
    index = arrays["index"]
    if len(np.unique(index)) < len(index):
        raise SequenceError(f"{path} has a keyframe twice")
    for k, T_WC in enumerate(arrays["T_WC"]):
        with parsing(path, _WHAT):
            check_pose(f"T_WC of keyframe {k}", torch.from_numpy(T_WC), SAVED_RIGIDITY_ERROR)
    for name in ("uv", "xyz_C", "sigma_px"):
        if not np.isfinite(arrays[name]).all():
            raise SequenceError(f"{path}: {name} must be finite; expected {_WHAT}")
    size = (camera.width, camera.height)
    if n and not (arrays["uv"].min() >= 0 and (arrays["uv"] <= size).all()):
        raise SequenceError(f"{path}: uv must lie in the image of {size[0]} x {size[1]} pixels")
    if n and arrays["sigma_px"].min() <= 0:
        raise SequenceError(f"{path}: sigma_px must be above 0; expected {_WHAT}")
    if not (arrays["xyz_C"][arrays["has_depth"], 2] > 0).all():
        raise SequenceError(f"{path}: points with depth must be in front of the camera")
