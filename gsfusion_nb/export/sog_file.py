"""Reading ``.sog`` files (PlayCanvas, version 2): a zip archive of lossless WebP pictures, a pixel per Gaussian.

``meta.json`` names the pictures. Positions have 16 bits, in two pictures, between bounds of sign(x) log(|x| + 1);
rotations are stored without their largest part, whose place is the fourth channel (252 + place in wxyz); bytes of
scales and colours are places in tables of 256 numbers; the coefficients of higher degree are rows of a palette.
"""

import io
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from ..checks import shown
from ..files import SequenceError, open_archive, parse_json, parsing, read_member
from ..types import GaussianParams
from .packed_values import params_of, quaternion_of_three

WHAT = "a .sog file of Gaussians"
_MEMBER_BYTES = 512_000_000
_MAX_PIXELS = 1 << 27
_PALETTE_COLUMNS = 64


def read_sog(path: str | Path) -> GaussianParams:
    """Read a ``.sog`` file of version 2.

    Raises:
        FileNotFoundError: no such file. ValueError: another kind of file, another version, or damaged.
    """
    path = Path(path)
    with open_archive(path, WHAT) as archive, parsing(path, WHAT):
        return _Sog(path, archive).params()


class _Sog:
    """An open archive."""

    def __init__(self, path: Path, archive: zipfile.ZipFile):
        self.path, self.archive = path, archive
        text = self._member("meta.json").decode("utf-8")
        self.meta = parse_json(text, f"{path}: meta.json", WHAT)
        version = self.meta.get("version") if isinstance(self.meta, dict) else None
        if version != 2:
            raise SequenceError(f"{path} has the version {shown(version)}; expected {WHAT}, version 2")
        count = self.meta.get("count")
        if type(count) is not int or not 0 <= count <= _MAX_PIXELS:
            raise SequenceError(f"{path} has the count {shown(count)}; expected a number of Gaussians")
        self.n: int = count

    def params(self) -> GaussianParams:
        low, high = self._pictures("means", 2)
        whole = low[:, :3].astype(np.float64) + 256.0 * high[:, :3]
        mins, maxs = (self._numbers("means", side, 3) for side in ("mins", "maxs"))
        logs = mins + (maxs - mins) * whole / 65535
        (quats,), (scales,), (sh0,) = (self._pictures(part, 1) for part in ("quats", "scales", "sh0"))
        place = quats[:, 3].astype(np.int64) - 252
        three = (quats[:, :3] / 127.5 - 1.0) / np.sqrt(2.0)
        quat = quaternion_of_three(three, np.clip(place, 0, 3))
        quat[place < 0] = (1.0, 0, 0, 0)
        dc = self._numbers("sh0", "codebook", 256)[sh0[:, :3]]
        return params_of(
            np.sign(logs) * np.expm1(np.abs(logs)), self._numbers("scales", "codebook", 256)[scales[:, :3]], quat,
            sh0[:, 3] / 255.0, np.concatenate([dc[:, None], self._rest()], axis=1),
        )  # fmt: skip

    def _rest(self) -> np.ndarray:
        """The coefficients of higher degree. [N, K - 1, 3]"""
        if "shN" not in self.meta:
            return np.zeros((self.n, 0, 3))
        bands, colours = self._part("shN").get("bands"), self._part("shN").get("count")
        if bands not in (1, 2, 3) or type(colours) is not int or not 0 < colours <= 65536:
            raise SequenceError(f"{self.path} has a palette of {shown(colours)} rows of degree {shown(bands)}")
        K = (bands + 1) ** 2 - 1
        palette = self._picture(self._files("shN", 2)[0])
        rows = palette.shape[0] * _PALETTE_COLUMNS
        if palette.shape[1] != _PALETTE_COLUMNS * K or rows < colours:
            raise SequenceError(f"{self.path} has a palette of {palette.shape[:2]} pixels for {colours} rows of {K}")
        table = self._numbers("shN", "codebook", 256)[palette[..., :3].reshape(rows, K, 3)]
        labels = self._rows(self._files("shN", 2)[1]).astype(np.int64)
        label = labels[:, 0] + 256 * labels[:, 1]
        if self.n and int(label.max()) >= colours:
            raise SequenceError(f"{self.path} refers to row {int(label.max())} of a palette of {colours}; damaged")
        return table[label]

    def _part(self, name: str) -> dict[str, Any]:
        part = self.meta.get(name)
        if not isinstance(part, dict):
            raise SequenceError(f"{self.path} has {shown(part)} as {name}; expected {WHAT}")
        return part

    def _numbers(self, part: str, name: str, n: int) -> np.ndarray:
        values = self._part(part).get(name)
        if not isinstance(values, list) or len(values) != n or not all(type(v) in (int, float) for v in values):
            raise SequenceError(f"{self.path} must have {n} numbers as {part}.{name}, got {shown(values)}")
        return np.array(values, dtype=np.float64)

    def _files(self, part: str, n: int) -> list[str]:
        names = self._part(part).get("files")
        if not isinstance(names, list) or len(names) != n or not all(isinstance(name, str) for name in names):
            raise SequenceError(f"{self.path} must name {n} pictures as {part}.files, got {shown(names)}")
        return names

    def _pictures(self, part: str, n: int) -> list[np.ndarray]:
        """The pixels of the Gaussians in the pictures of a part. [N, 4] each"""
        return [self._rows(name) for name in self._files(part, n)]

    def _rows(self, name: str) -> np.ndarray:
        pixels = self._picture(name).reshape(-1, 4)
        if len(pixels) < self.n:
            raise SequenceError(f"{self.path}: {name} has {len(pixels)} pixels for {self.n} Gaussians; it is damaged")
        return pixels[: self.n]

    def _picture(self, name: str) -> np.ndarray:
        """A picture as bytes. [H, W, 4]"""
        from PIL import Image

        with Image.open(io.BytesIO(self._member(name))) as image:
            if image.width * image.height > _MAX_PIXELS:
                raise SequenceError(f"{self.path}: {name} has {image.width} x {image.height} pixels; too large")
            return np.asarray(image.convert("RGBA"))

    def _member(self, name: str) -> bytes:
        try:
            return read_member(self.archive, name, self.path, at_most=_MEMBER_BYTES)
        except KeyError:
            raise SequenceError(f"{self.path} has no {shown(name)}; expected {WHAT}") from None
