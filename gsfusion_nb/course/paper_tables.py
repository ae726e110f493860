"""The ablations of the GSFusion paper (Wei & Leutenegger 2024, Tables IV-VIII), to compare your own runs with."""

from collections.abc import Mapping
from dataclasses import dataclass

Row = Mapping[str, float | int]


@dataclass(frozen=True)
class PaperTable:
    """One ablation as printed. PSNR and SSIM on ScanNet++ are those of the novel views."""

    number: str
    title: str
    data: str
    rows: Mapping[str, Row]
    """Setting -> column -> value, in the paper's order."""


PAPER_TABLES: dict[str, PaperTable] = {
    "IV": PaperTable("IV", "TSDF voxel size", "ScanNet++, novel views", {
        "1 cm": {"PSNR": 25.45, "SSIM": 0.848, "FPS": 6.14, "MB": 29.3},
        "5 cm": {"PSNR": 25.31, "SSIM": 0.846, "FPS": 8.97, "MB": 21.4},
    }),
    "V": PaperTable("V", "quadtree threshold", "ScanNet++, novel views", {
        "0.01": {"PSNR": 25.96, "SSIM": 0.853, "FPS": 5.09, "MB": 48.8},
        "0.1": {"PSNR": 25.45, "SSIM": 0.848, "FPS": 6.14, "MB": 29.3},
    }),
    "VI": PaperTable("VI", "passes of the global optimisation", "ScanNet++, novel views", {
        "0": {"PSNR": 22.76, "SSIM": 0.794, "global s": 0.0},
        "10": {"PSNR": 25.45, "SSIM": 0.848, "global s": 60.1},
        "20": {"PSNR": 25.87, "SSIM": 0.856, "global s": 120.7},
    }),
    "VII": PaperTable("VII", "random keyframe optimisation", "Replica, no global optimisation", {
        "without": {"PSNR": 24.22, "SSIM": 0.849, "FPS": 9.70},
        "with": {"PSNR": 28.64, "SSIM": 0.900, "FPS": 9.74},
    }),
    "VIII": PaperTable("VIII", "keyframe threshold", "Replica", {
        "40": {"PSNR": 35.44, "SSIM": 0.955, "keyframes": 655, "global s": 167.3},
        "50": {"PSNR": 34.65, "SSIM": 0.949, "keyframes": 594, "global s": 151.5},
        "90": {"PSNR": 33.26, "SSIM": 0.941, "keyframes": 414, "global s": 105.5},
    }),
}  # fmt: skip

_FORMATS = {"PSNR": ".2f", "SSIM": ".3f", "FPS": ".1f", "MB": ".1f", "global s": ".1f", "keyframes": ",.0f"}


class PaperComparison:
    """An ablation of the paper and your own runs, row by row.

    Args:
        number: "IV" to "VIII".
        ours: Setting -> column -> value; only the paper's columns, and "Gaussians", are shown. Settings that the paper
            does not have are shown with ours alone. Settings that begin with a number are sorted by it.

    Raises:
        KeyError: the paper has no such ablation.
    """

    def __init__(self, number: str, ours: Mapping[str, Row]):
        if number not in PAPER_TABLES:
            raise KeyError(f"the paper has no ablation table {number!r}; there are: {', '.join(PAPER_TABLES)}")
        self.paper, self.ours = PAPER_TABLES[number], dict(ours)
        self.columns = list(dict.fromkeys(c for row in self.paper.rows.values() for c in row))
        if any("Gaussians" in row for row in self.ours.values()):
            self.columns.append("Gaussians")

    @property
    def title(self) -> str:
        """One line above the table."""
        return f"Table {self.paper.number}, {self.paper.title}: here (in the paper on {self.paper.data})"

    def lines(self) -> list[list[str]]:
        """Cells, the headings first: ours, and the paper's in brackets."""
        settings = _in_order(list(dict.fromkeys([*self.paper.rows, *self.ours])))
        rows = [[self.paper.title, *self.columns]]
        for setting in settings:
            mine, theirs = self.ours.get(setting, {}), self.paper.rows.get(setting, {})
            rows.append([setting, *(_cell(c, mine, theirs) for c in self.columns)])
        return rows

    def __repr__(self) -> str:
        rows = self.lines()
        widths = [max(len(row[k]) for row in rows) for k in range(len(rows[0]))]
        text = []
        for row in rows:
            sides = ["<", *">" * (len(row) - 1)]
            text.append("  ".join(f"{c:{side}{w}}" for c, side, w in zip(row, sides, widths, strict=True)))
        return "\n".join([self.title, *text])


def _in_order(settings: list[str]) -> list[str]:
    """Sorted by the number that each begins with; in the given order if one has none."""
    try:
        return sorted(settings, key=lambda setting: float(setting.split()[0]))
    except ValueError:
        return settings


def _cell(column: str, mine: Row, theirs: Row) -> str:
    form = _FORMATS.get(column, ",.0f")
    own = format(mine[column], form) if column in mine else "-"
    return f"{own} ({theirs[column]:{form}})" if column in theirs else own
