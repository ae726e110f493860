"""The file that describes a comparison: rules x scenes x seeds x budgets. All of it is checked before anything runs."""

import re
import tomllib
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ..errors import SequenceError, shown
from ..foreign import read_text
from ..mapping import SYSTEMS
from ..seeding import SeedingRule
from ..seeding.rule_code import is_rule_file, read_rule_file
from .entries import RULE_CHECKS, check_size_range
from .map_scene import Entry
from .spec import Budget, RunSpec, identity_of, label_of

_TOP = {"seeds": (int, list), "reference": (str,), "system": (str,), "preset": (str,), "device": (str,),
        "settings": (dict,), "rules": (list,), "scenes": (list,), "budgets": (list,)}  # fmt: skip
_RULE = {"rule": (str,), "label": (str,), "options": (dict,), "size_option": (str,), "size_range": (list,),
         "tuned_on": (str,), "settings": (dict,)}  # fmt: skip
_SCENE = {"data": (str,), "label": (str,), "reader": (dict,), "settings": (dict,), "preset": (str,)}
_BUDGET = {"steps": (str,), "gaussians": (int,), "seconds": (int, float), "tolerance": (int, float)}
_WORDS = {int: "a whole number", float: "a number", str: "a text", list: "a list", dict: "a table"}


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
        TableError: mistakes, each with its line, what was expected and what came. FileNotFoundError: no such file.
    """
    path = Path(path).expanduser()
    if not path.is_file():
        raise FileNotFoundError(f"{path} does not exist; gsfusion-nb lab --new {path} writes an example")
    text = read_text(path, "the file of a comparison")
    try:
        values = tomllib.loads(text)
    except tomllib.TOMLDecodeError as e:
        raise TableError(f"{path}: not a TOML file: {e}") from None
    return _Reader(path, text, values, skip_missing).table()


class _Reader:
    """Reads one file, and collects its mistakes."""

    def __init__(self, path: Path, text: str, values: dict[str, Any], skip_missing: bool):
        self.path, self.text, self.skip_missing = path, text, skip_missing
        self.skipped: list[str] = []
        self.lines = _lines_of(text)
        self.problems: list[str] = []
        self.top = self._checked("", 0, values, _TOP)
        system = self.top.get("system", "gsfusion")
        if system not in SYSTEMS:
            self._wrong("", 0, "system", f"expected one of {', '.join(SYSTEMS)}, got {shown(system)}")
            system = "gsfusion"
        self.shared: dict[str, Any] = {name: self.top[name] for name in ("preset", "device") if name in self.top} | {
            "system": system
        }

    def table(self) -> Table:
        """The comparison, or all its mistakes."""
        self._settings("settings", 0, self.top.get("settings", {}))
        seeds = self._seeds(self.top.get("seeds", 1))
        budgets = [self._budget(i, v) for i, v in self._tables("budgets", _BUDGET, "")] or [Budget()]
        tuned = next((budget for budget in budgets if budget.gaussians is not None), budgets[0])
        rules = [self._rule(i, v, tuned) for i, v in self._tables("rules", _RULE, "rule")]
        tuned_on = {rule["label"]: words for rule in rules if (words := rule.pop("tuned_on", ""))}
        reference = self.top.get("reference", "")
        if reference and reference not in (labels := [rule["label"] for rule in rules]):
            self._wrong(
                "", 0, "reference", f"expected the label of a rule ({', '.join(labels)}), got {shown(reference)}"
            )
        scenes = [self._scene(i, v) for i, v in self._tables("scenes", _SCENE, "data")]
        if self.skip_missing:
            scenes = [scene for scene in scenes if not self._is_missing(scene)]
            if not scenes:
                self.problems.append(f"{self.path}: no scene is left: {'; '.join(self.skipped)}")
        self._raise()
        self._unique("rules", [rule["label"] for rule in rules])
        self._unique("scenes", [scene["scene"] for scene in scenes])
        specs = []
        for scene in scenes:
            for budget in budgets:
                for rule in rules:
                    settings = {**_dotted(self.top.get("settings", {})), **scene["settings"], **rule["settings"]}
                    parts = {**self.shared, **scene, **rule, "settings": settings, "budget": budget}
                    specs += [RunSpec(**parts, seed=seed) for seed in seeds]
        self._open_scenes({spec.scene: spec for spec in reversed(specs)}, [scene["scene"] for scene in scenes])
        self._raise()
        return Table(
            specs=specs, text=self.text, reference=reference, tuned_on=tuned_on, skipped=tuple(self.skipped)
        )  # fmt: skip

    def _is_missing(self, scene: Mapping[str, Any]) -> bool:
        missing = scene["data"] != "room" and not Path(scene["data"]).is_dir()
        if missing:
            self.skipped.append(f"{scene['scene']}: there is no folder {scene['data']}")
        return missing

    def _seeds(self, given: int | list) -> list[int]:
        seeds = list(range(given)) if isinstance(given, int) else given
        if not seeds or any(not isinstance(s, int) or isinstance(s, bool) or s < 0 for s in seeds):
            self._wrong("", 0, "seeds", f"expected a number of seeds, or a list of whole numbers, got {shown(given)}")
        return seeds

    def _rule(self, i: int, values: dict[str, Any], budget: Budget) -> dict[str, Any]:
        """A rule as parts of a spec, checked for a budget."""
        words = {"tuned_on": values.pop("tuned_on")} if "tuned_on" in values else {}
        parts: dict[str, Any] = {"settings": {}, "label": ""} | values
        parts["settings"] = self._settings("rules", i, parts["settings"])
        label = parts["label"] or label_of(parts["rule"].rpartition(":")[2], parts.get("options", {}))
        try:
            if is_rule_file(parts["rule"]):
                place = self.path.parent / parts["rule"]
                parts["rule_source"], _ = read_rule_file(str(place))
            rule = Entry(spec=RunSpec(rule=parts["rule"], rule_source=parts.get("rule_source", ""))).found_rule()
        except (ValueError, KeyError, TypeError, OSError) as e:
            self._wrong("rules", i, "rule", _text(e))
            return parts | {"label": label} | words
        if "size_range" in parts:
            parts["size_range"] = self._size_range(i, parts["size_range"])
        together = _dotted(self.top.get("settings", {})) | parts["settings"]
        if not self._refused(together):
            spec = RunSpec(**self.shared | parts | {"settings": together, "budget": budget})
            self._check_rule(i, spec, rule)
        try:
            parts |= identity_of(rule, parts.get("options", {}))
        except (TypeError, OSError) as e:
            self._wrong("rules", i, "options", str(e))
        return parts | {"label": label} | words

    def _check_rule(self, i: int, spec: RunSpec, rule: SeedingRule) -> None:
        for key, check in RULE_CHECKS.items():
            try:
                check(spec, rule)
            except (TypeError, ValueError) as e:
                self._wrong("rules", i, key, str(e))
                return

    def _size_range(self, i: int, given: list) -> tuple[float | int, float | int] | None:
        try:
            check_size_range(given)
        except ValueError as e:
            self._wrong("rules", i, "size_range", str(e))
            return None
        return given[0], given[1]

    def _scene(self, i: int, values: dict[str, Any]) -> dict[str, Any]:
        """A scene as parts of a spec."""
        data = values["data"]
        if data != "room" and not Path(data).expanduser().is_absolute():
            beside = self.path.parent / data
            data = str(beside if beside.is_dir() else Path(data).resolve())
        preset = {"preset": values["preset"]} if "preset" in values else {}
        return preset | {
            "data": data, "scene": values.get("label", Path(values["data"]).name), "reader": values.get("reader", {}),
            "settings": self._settings("scenes", i, values.get("settings", {})),
        }  # fmt: skip

    def _budget(self, i: int, values: dict[str, Any]) -> Budget:
        if "steps" in values and values["steps"] not in ("equal", "own"):
            self._wrong("budgets", i, "steps", f'expected "equal" or "own", got {shown(values["steps"])}')
            return Budget()
        try:
            return Budget(**values)
        except ValueError as e:
            name = next((name for name in values if f"budget.{name}" in str(e)), "")
            self._wrong("budgets", i, name, str(e).removeprefix(f"budget.{name} "))
            return Budget()

    def _settings(self, table: str, i: int, given: dict[str, Any]) -> dict[str, Any]:
        """Settings by dotted name, checked together with those of all runs."""
        own = _dotted(given)
        together = own if table == "settings" else _dotted(self.top.get("settings", {})) | own
        error = self._refused(together)
        if error and own:
            without = (name for name in own if not self._refused({k: v for k, v in together.items() if k != name}))
            self._wrong(table, i, next(without, next(iter(own))), error)
        return own

    def _refused(self, settings: dict[str, Any]) -> str:
        """Why settings are refused; empty if they are not."""
        try:
            RunSpec(rule="uniform", **self.shared, settings=settings).config()
        except (ValueError, TypeError, KeyError) as e:
            return _text(e)
        return ""

    def _tables(self, name: str, known: Mapping[str, tuple], required: str) -> list[tuple[int, dict[str, Any]]]:
        """The tables [[name]] of the file, with their types checked."""
        tables = self.top.get(name, [])
        if required and not tables:
            self.problems.append(f"{self.path}: expected at least one table [[{name}]] with {required} = ..., got none")
        found = []
        for i, values in enumerate(tables):
            if not isinstance(values, dict):
                self.problems.append(f"{self.path}: expected [[{name}]] to be a table, got {shown(values)}")
                continue
            before = len(self.problems)
            checked = self._checked(name, i, values, known)
            if required and required not in values:
                self._wrong(name, i, "", f"expected the key {required}, got {', '.join(values) or 'an empty table'}")
            if len(self.problems) == before:
                found.append((i, checked))
        return found

    def _checked(self, table: str, i: int, values: dict[str, Any], known: Mapping[str, tuple]) -> dict[str, Any]:
        """The values whose names and types are right; the others are noted."""
        good = {}
        for name, value in values.items():
            if name not in known:
                self._wrong(table, i, name, f"no such key; known: {', '.join(known)}")
            elif isinstance(value, bool) or not isinstance(value, known[name]):
                wanted = " or ".join(
                    _WORDS[kind] for kind in known[name] if kind is not int or float not in known[name]
                )
                self._wrong(table, i, name, f"expected {wanted}, got {shown(value)}")
            else:
                good[name] = value
        return good

    def _open_scenes(self, specs: Mapping[str, RunSpec], scenes: list[str]) -> None:
        """Note the scenes that cannot be opened, or have no view to score."""
        for i, scene in enumerate(scenes):
            if scene not in specs:
                continue
            try:
                held_out = len(Entry(spec=specs[scene]).opened().held_out)
            except (SequenceError, ValueError, TypeError, KeyError) as e:
                self._wrong("scenes", i, "data", _text(e))
                continue
            if held_out == 0:
                self._wrong(
                    "scenes", i, "data", "no view is held out for the scores: set data.hold_out_every to 2 or more"
                )

    def _unique(self, table: str, names: list[str]) -> None:
        for i, name in enumerate(names):
            if name in names[:i]:
                self._wrong(table, i, "label", f"expected names that differ, got {shown(name)} twice; set label")

    def _wrong(self, table: str, i: int, key: str, what: str) -> None:
        names = (key.replace("-", "_"), key.rpartition(".")[2].replace("-", "_"), "")
        line = next((self.lines[table, i, name] for name in names if (table, i, name) in self.lines), None)
        place = f"{self.path}, line {line}" if line else str(self.path)
        name = ".".join(filter(None, (f"{table}[{i}]" if table else "", key)))
        self.problems.append(f"{place}: {name}: {what}")

    def _raise(self) -> None:
        if self.problems:
            raise TableError("\n".join(dict.fromkeys(self.problems)))


def _lines_of(text: str) -> dict[tuple[str, int, str], int]:
    """(table, its number, key) -> line, from 1; the key is empty for the heading of a table."""
    lines: dict[tuple[str, int, str], int] = {}
    table: tuple[str, int] = ("", 0)
    counts = Counter[str]()
    for number, line in enumerate(text.splitlines(), start=1):
        heading = re.match(r"\s*\[\[?\s*([\w.\"-]+)\s*\]", line)
        if heading:
            name = heading[1].strip('"')
            table = (name, counts[name])
            counts[name] += 1
            lines[table[0], table[1], ""] = number
        elif key := re.match(r'\s*(?:"([^"]+)"|([\w.-]+))\s*=', line):
            inner = re.findall(r'[{,]\s*"?([\w.-]+)"?\s*=', line)
            for name in (key[1] or key[2], *inner):
                lines.setdefault((table[0], table[1], name.replace("-", "_")), number)
    return lines


def _dotted(values: Mapping[str, Any], path: str = "") -> dict[str, Any]:
    """Settings by dotted name, also where the file nests them."""
    found: dict[str, Any] = {}
    for name, value in values.items():
        full = f"{path}{name}".replace("-", "_")
        found |= _dotted(value, f"{full}.") if isinstance(value, dict) and full != "seeding.options" else {full: value}
    return found


def _text(error: Exception) -> str:
    return str(error.args[0]) if isinstance(error, KeyError) and error.args else str(error)


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
