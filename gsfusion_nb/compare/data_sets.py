"""Data sets with a published protocol: those of this package, and those of the user's own."""

import dataclasses
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ..checks import check_name, shown
from ..data.open import known_layouts
from ..errors import ArgumentError
from ..files import read_text
from .statistics import Better, Column
from .studies import read_packaged

COLUMNS = {
    "psnr": ("PSNR, dB", ".2f", "psnr_{}_db", 1),
    "ssim": ("SSIM", ".3f", "ssim_{}", 1),
    "lpips": ("LPIPS", ".3f", "lpips_{}", 1),
    "ate": ("ATE RMSE, cm", ".2f", "ate_rmse_m", 100),
    "fps": ("frames/s", ".2f", "fps_mean_inverse", 1),
    "mb": ("MB", ".1f", "model_size_mb", 1),
    "memory": ("memory, MB", ".0f", "peak_memory_mb", 1),
}
"""Column -> heading, format, our metric with {} for the group of views, and factor to the unit
shown."""


@dataclass(frozen=True, kw_only=True)
class DataSet:
    """How a data set is measured."""

    title: str
    format: str
    """Name of its reader."""
    preset: str
    views: str
    """Views that are scored: mapped or held_out."""
    scenes: Sequence[str]
    """Names of the folders of the scenes that papers report."""
    settings: Mapping[str, Any]
    """Settings of all runs."""
    protocol: Sequence[str]
    """Sentences about the published protocol: which frames are mapped, which are scored, and what
    cannot be compared."""
    reader: Mapping[str, Any] = field(default_factory=dict)
    published: Sequence[Mapping[str, Any]] = ()
    """Rows of papers, means over the scenes: system, source (paper and table), numbers (column ->
    value)."""
    tables: Sequence[Mapping[str, Any]] = ()
    """Tables of papers with other columns, or of other data: title, columns, and rows (name ->
    values as text)."""


DATA_SETS = {
    name: DataSet(**values)
    for name, values in read_packaged(Path(__file__).with_name("benchmark.toml")).items()
}
"""Name -> data set of this package."""

_BETTER: Mapping[str, Better] = {"psnr": "higher", "ssim": "higher", "fps": "higher"}


def column_of(name: str) -> Column:
    """A column of ``COLUMNS`` as the tables for papers have it, of numbers in the unit shown."""
    heading, form, *_ = COLUMNS[name]
    words, _, unit = heading.partition(", ")
    return Column(
        metric=name,
        heading=words[0].upper() + words[1:],
        unit=unit,
        digits=int(form.strip(".f")),
        better=_BETTER.get(name, "lower"),
    )


_NEEDED = ("title", "format", "scenes", "views")
_FIELDS = {f.name: f for f in dataclasses.fields(DataSet)}


def data_set_of(text: str) -> DataSet:
    """The data set of a name, or of a TOML file with tables as in ``benchmark.toml``.

    A table of the file that has the name of a data set of this package adds rows and tables to it.

    Args:
        text: A name in ``DATA_SETS``, "FILE.toml", or "FILE.toml:NAME" if the file has several.

    Raises:
        KeyError: no such data set. FileNotFoundError: no such file. ValueError: a mistake in the
            file; the message says where.
    """
    file, colon, name = text.rpartition(":") if ".toml:" in text else (text, "", "")
    if not file.endswith(".toml"):
        check_name("data set", text, DATA_SETS)
        return DATA_SETS[text]
    path = Path(file).expanduser()
    if not path.is_file():
        raise FileNotFoundError(f"{path} does not exist; expected a file of data sets")
    try:
        tables = tomllib.loads(read_text(path, "a file of data sets"))
    except tomllib.TOMLDecodeError as e:
        raise ArgumentError(f"{path}: {e}") from None
    if not colon and len(tables) != 1:
        raise ArgumentError(
            f"{path} has {len(tables)} data sets, {', '.join(tables) or 'none'}; name one: "
            f"{path}:NAME"
        )
    name = name or next(iter(tables))
    check_name(f"data set in {path}", name, tables)
    return _data_set(f"{path}: [{name}]", name, tables[name])


def _data_set(place: str, name: str, values: Any) -> DataSet:
    if not isinstance(values, dict):
        raise ArgumentError(f"{place}: expected a table, got {shown(values)}")
    base = DATA_SETS.get(name)
    for key, value in values.items():
        check_name(f"key, {place}:", key, _FIELDS)
        wanted = str if key in ("title", "format", "preset", "views") else list
        wanted = dict if key in ("settings", "reader") else wanted
        if not isinstance(value, wanted):
            raise ArgumentError(f"{place}: {key}: expected {wanted.__name__}, got {shown(value)}")
    for row in values.get("published", []):
        if not (isinstance(row, dict) and {"system", "source", "numbers"} == row.keys()):
            raise ArgumentError(
                f"{place}: a row of published needs system, source and numbers, got {shown(row)}"
            )
        for column in row["numbers"]:
            check_name(f"column, {place}, published row {row['system']}:", column, COLUMNS)
    if base is not None:
        return dataclasses.replace(
            base,
            published=[*base.published, *values.get("published", [])],
            tables=[*base.tables, *values.get("tables", [])],
            **{k: v for k, v in values.items() if k not in ("published", "tables")},
        )
    if missing := [key for key in _NEEDED if key not in values]:
        raise ArgumentError(f"{place}: expected {', '.join(missing)} as well")
    check_name(f"layout, {place}:", values["format"], known_layouts())
    check_name(f"group of views, {place}:", values["views"], ("mapped", "held_out"))
    return DataSet(**{"preset": "replica", "settings": {}, "protocol": []} | values)
