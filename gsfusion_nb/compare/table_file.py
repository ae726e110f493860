"""The file that describes a comparison: rules x scenes x seeds x budgets. All of it is checked before anything runs."""

import itertools
import tomllib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ..checks import shown
from ..files import SequenceError, read_text
from ..mapping import get_system
from ..seeding.rule_code import is_rule_file, read_rule_file
from .entries import check_run
from .map_scene import Entry
from .spec import Budget, RunSpec, identity_of, label_of

_TOP = {"seeds": (int, list), "reference": (str,), "system": (str,), "preset": (str,), "device": (str,),
        "settings": (dict,), "rules": (list,), "scenes": (list,), "budgets": (list,)}  # fmt: skip
_RULE = {"rule": (str,), "label": (str,), "options": (dict,), "size_option": (str,), "size_range": (list,),
         "tuned_on": (str,), "settings": (dict,)}  # fmt: skip
_SCENE = {"data": (str,), "label": (str,), "reader": (dict,), "settings": (dict,), "preset": (str,)}
_BUDGET = {"steps": (str,), "gaussians": (int,), "seconds": (int, float), "tolerance": (int, float)}
_WORDS = {int: "a whole number", float: "a number", str: "a text", list: "a list", dict: "a table"}
Kinds = Mapping[str, tuple[type, ...]]


class TableError(ValueError):
    """What is wrong in a file that describes a comparison: one line for each mistake."""


@dataclass(frozen=True, kw_only=True)
class Table:
    """A comparison that can be run."""

    specs: list[RunSpec] = field(default_factory=list)
    """Its runs: by scene, budget, rule and seed."""
    text: str = ""
    """The file."""
    reference: str = ""
    """Label of the rule that all others are tested against; the best one if empty."""
    tuned_on: Mapping[str, str] = field(default_factory=dict)
    """Label of a rule -> the scenes that its values were chosen on, in words."""
    skipped: tuple[str, ...] = ()
    """Scenes that were left out because their data is not there, with the folder."""

    def __str__(self) -> str:
        counts = {
            "rule": len({s.label for s in self.specs}), "scene": len({s.scene for s in self.specs}),
            "seed": len({s.seed for s in self.specs}), "budget": len({s.budget for s in self.specs}),
        }  # fmt: skip
        words = " x ".join(f"{n} {name}{'s' if n > 1 else ''}" for name, n in counts.items())
        return "\n".join([f"{len(self.specs)} runs: {words}", *(f"left out: {line}" for line in self.skipped)])


def read_table(path: str | Path, *, skip_missing: bool = False) -> Table:
    """Read and check the file of a comparison.

    Args:
        path: The file.
        skip_missing: Leave out the scenes whose folder does not exist; otherwise they are mistakes.

    Raises:
        TableError: mistakes, each with its place in the file, what was expected and what came.
        FileNotFoundError: no such file.
    """
    path = Path(path).expanduser()
    if not path.is_file():
        raise FileNotFoundError(f"{path} does not exist; gsfusion-nb lab --new {path} writes an example")
    text = read_text(path, "the file of a comparison")
    try:
        values = tomllib.loads(text)
    except tomllib.TOMLDecodeError as e:
        raise TableError(f"{path}: not a TOML file: {e}") from None
    return _Reader(path, text, skip_missing).table(values)


class _Reader:
    """Reads one file, and collects its mistakes."""

    def __init__(self, path: Path, text: str, skip_missing: bool):
        self.path, self.text, self.skip_missing = path, text, skip_missing
        self.problems: list[str] = []
        self.skipped: list[str] = []
        self.shared: dict[str, Any] = {}
        self.settings: dict[str, Any] = {}

    def table(self, values: dict[str, Any]) -> Table:
        """The comparison, or all its mistakes."""
        top = self._checked("", values, _TOP)
        self.shared = {name: top[name] for name in ("system", "preset", "device") if name in top}
        self.settings = _dotted(top.get("settings", {}))
        self._try("system", lambda: get_system(top.get("system", "gsfusion")))
        self._raise()
        self._try("settings", lambda: RunSpec(rule="uniform", **self.shared, settings=self.settings).config())
        seeds = self._seeds(top.get("seeds", 1))
        budgets = self._each(top, "budgets", _BUDGET, "", lambda values: Budget(**values)) or [Budget()]
        tuned = next((budget for budget in budgets if budget.gaussians is not None), budgets[0])
        rules = self._each(top, "rules", _RULE, "rule", lambda values: self._rule(values, tuned))
        self._raise()
        scenes = self._each(top, "scenes", _SCENE, "data", self._scene)
        scenes = [scene for scene in scenes if scene]
        if not scenes:
            self.problems.append(f"{self.path}: no scene is left: {'; '.join(self.skipped)}")
        tuned_on = {rule["label"]: words for rule in rules if (words := rule.pop("tuned_on", ""))}
        labels, reference = [rule["label"] for rule in rules], top.get("reference", "")
        if reference and reference not in labels:
            self._wrong("reference", f"expected the label of a rule ({', '.join(labels)}), got {shown(reference)}")
        for table, names in (("rules", labels), ("scenes", [scene["scene"] for scene in scenes])):
            for name in {name for name in names if names.count(name) > 1}:
                self._wrong(table, f"expected names that differ, got {shown(name)} twice; set label")
        self._raise()
        specs = []
        for scene, budget, rule, seed in itertools.product(scenes, budgets, rules, seeds):
            settings = {**self.settings, **scene["settings"], **rule["settings"]}
            parts = {**self.shared, **scene, **rule, "settings": settings}
            specs.append(RunSpec(**parts, budget=budget, seed=seed))
        return Table(specs=specs, text=self.text, reference=reference, tuned_on=tuned_on, skipped=tuple(self.skipped))

    def _seeds(self, given: int | list) -> list[int]:
        seeds = list(range(given)) if isinstance(given, int) else given
        if not seeds or any(not isinstance(s, int) or isinstance(s, bool) or s < 0 for s in seeds):
            self._wrong("seeds", f"expected a number of seeds, or a list of whole numbers, got {shown(given)}")
        return seeds

    def _rule(self, values: dict[str, Any], budget: Budget) -> dict[str, Any]:
        """A rule as parts of a spec, checked for a budget."""
        parts: dict[str, Any] = values | {"settings": _dotted(values.get("settings", {}))}
        parts["label"] = values.get("label") or label_of(values["rule"].rpartition(":")[2], values.get("options", {}))
        tuned_on = parts.pop("tuned_on", "")
        if is_rule_file(parts["rule"]):
            parts["rule_source"], _ = read_rule_file(str(self.path.parent / parts["rule"]))
        if "size_range" in parts:
            parts["size_range"] = tuple(parts["size_range"])
        spec = RunSpec(**self.shared | parts | {"settings": self.settings | parts["settings"], "budget": budget})
        rule = Entry(spec=spec).found_rule()
        check_run(spec, rule)
        return parts | identity_of(rule, parts.get("options", {})) | {"tuned_on": tuned_on}

    def _scene(self, values: dict[str, Any]) -> dict[str, Any]:
        """A scene as parts of a spec; empty if it is left out."""
        data, name = values["data"], values.get("label", Path(values["data"]).name)
        if data != "room" and not Path(data).expanduser().is_absolute():
            beside = self.path.parent / data
            data = str(beside if beside.is_dir() else Path(data).resolve())
        if self.skip_missing and data != "room" and not Path(data).is_dir():
            self.skipped.append(f"{name}: there is no folder {data}")
            return {}
        parts: dict[str, Any] = {"preset": values["preset"]} if "preset" in values else {}
        parts |= {"data": data, "scene": name, "reader": values.get("reader", {})}
        settings = _dotted(values.get("settings", {}))
        spec = RunSpec(rule="uniform", **self.shared | parts, settings=self.settings | settings)
        if len(Entry(spec=spec).opened().held_out) == 0:
            raise ValueError("no view is held out for the scores: set data.hold_out_every to 2 or more")
        return parts | {"settings": settings}

    def _each(
        self, top: Mapping[str, Any], name: str, known: Kinds, required: str, make: Callable[[dict[str, Any]], Any]
    ) -> list[Any]:
        """What ``make`` makes of each table [[name]] whose types are right."""
        tables, found = top.get(name, []), []
        if required and not tables:
            self.problems.append(f"{self.path}: expected at least one table [[{name}]] with {required} = ..., got none")
        for i, values in enumerate(tables):
            place, before = f"{name}[{i}]", len(self.problems)
            if not isinstance(values, dict) or (required and required not in values):
                self._wrong(place, f"expected a table with the key {required or 'steps'}, got {shown(values)}")
                continue
            checked = self._checked(place, values, known)
            if len(self.problems) == before:
                found += self._try(place, lambda checked=checked: make(checked))
        return found

    def _try(self, place: str, make: Callable[[], Any]) -> list[Any]:
        """What ``make`` makes; nothing if it raises an error, which is noted."""
        try:
            return [make()]
        except (SequenceError, ValueError, TypeError, KeyError, OSError) as e:
            self._wrong(place, str(e.args[0]) if isinstance(e, KeyError) and e.args else str(e))
            return []

    def _checked(self, place: str, values: dict[str, Any], known: Kinds) -> dict[str, Any]:
        """The values whose names and types are right; the others are noted."""
        good = {}
        for name, value in values.items():
            where = f"{place}.{name}".strip(".")
            if name not in known:
                self._wrong(where, f"no such key; known: {', '.join(known)}")
            elif isinstance(value, bool) or not isinstance(value, known[name]):
                self._wrong(where, f"expected {' or '.join(_WORDS[kind] for kind in known[name])}, got {shown(value)}")
            else:
                good[name] = value
        return good

    def _wrong(self, place: str, what: str) -> None:
        self.problems.append(f"{self.path}: {place}: {what}")

    def _raise(self) -> None:
        if self.problems:
            raise TableError("\n".join(dict.fromkeys(self.problems)))


def _dotted(values: Mapping[str, Any], path: str = "") -> dict[str, Any]:
    """Settings by dotted name, also where the file nests them."""
    found: dict[str, Any] = {}
    for name, value in values.items():
        full = f"{path}{name}".replace("-", "_")
        found |= _dotted(value, f"{full}.") if isinstance(value, dict) and full != "seeding.options" else {full: value}
    return found


EXAMPLE = """\
# A comparison of seeding rules: every rule, on every scene, with every seed, at every budget.
#   gsfusion-nb lab THIS_FILE --jobs 2
# The same command again continues after Ctrl-C, and computes nothing twice.

seeds = [0, 1]         # or a number: seeds = 2 is the same. They change only random draws
# reference = "uniform"  # the label that all others are tested against; default: the best rule
system = "gsfusion"    # or "rtg_slam", "gps_slam"
# preset = "room"      # settings published for a data set; default: room for the room, else replica

[settings]             # of all runs; names as in gsfusion-nb map --help
"data.width" = 160
"data.height" = 120
"tsdf.voxel_size_m" = 0.02
"sh_degree" = 0
"seeding.quadtree_contrast" = "std"
"optim.global_iterations" = 3

[[scenes]]
data = "room"          # the built-in room, or the folder of a recording
label = "room"         # its name in the tables
reader = { n_frames = 60 }

[[scenes]]
data = "room"
label = "another room"
reader = { n_frames = 60, seed = 1, noise = "kinect" }

# A difference is tested over the scenes: use many, of many places.
# [[scenes]]
# data = "my_recording"  # a folder beside this file
# settings = { "data.stop" = 200, "data.stride" = 5 }
# If the folder has every fourth frame of a camera with 30 Hz already: "seeding.source_stride" = 20

[[budgets]]            # leave out all budgets for: equal steps, as many Gaussians as each rule makes
gaussians = 2000       # one option of each rule is tuned until its map has this many
tolerance = 0.05       # within 5 per cent
steps = "equal"        # the same gradient steps for every rule; "own": they follow from the rule's seeds
# seconds = 10         # or: equal wall time

[[rules]]
rule = "gsfusion"

[[rules]]
rule = "uniform"
# tuned_on = "room"    # the scenes that the values of a rule were chosen on: it is said under the table

[[rules]]
rule = "rtg_slam"
label = "RTG-SLAM's"
options = { transparent = false }

[[rules]]
rule = "dense"
size_option = "thin"   # the option that is tuned; "thin" keeps a random share of the seeds
label = "dense, thinned"

# [[rules]]
# rule = "my_rules.py:grid"    # a rule from a file beside this one
# size_option = "spacing_px"   # its option that decides how many Gaussians it makes
# size_range = [1, 100]
"""
"""A commented example of the file that describes a comparison."""
