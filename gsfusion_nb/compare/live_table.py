"""A comparison in a notebook: a table that fills while the runs are done, with buttons, and the pictures of a row."""

import contextlib
import functools
import html
import math
import threading
import time
import weakref
from collections import Counter
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import anywidget
import traitlets as t

from ..drawing.curves import figure_picture, figure_words
from ..drawing.page import fill
from ..drawing.pictures import Picture, data_uri
from ..mapping import StepReport
from ..viz.display import Bundle, with_picture
from ..viz.player import Player, player_buttons
from .executors import InProcess, Task, executor
from .map_scene import Entry
from .outputs import all_tables, write_outputs
from .page import views_of
from .pareto import pareto_figure, scene_points
from .run_all import ResultStore, run_all
from .spec import RunResult, RunSpec
from .statistics import Group, group_runs
from .tables import Cell, ResultTable, failures, scene_table


class _Stopped(BaseException):
    """Raised between two frames of a run that is given up; no ``except Exception`` holds it back."""


class LiveRuns(Iterator[RunResult | None]):
    """An iterator over the results of runs; one step does one run, or gives None if it was stopped.

    With one job the runs are done in the thread of the step and wait between two frames while paused.

    Args:
        runs: The runs.
        store: Where results are kept.
        jobs, dask: As for ``executors.executor``.
        on_frame: Called after each frame, and when a run has paused; only with one job.
    """

    def __init__(
        self, runs: Iterable[Entry | RunSpec], store: ResultStore, *, jobs: int = 1, dask: str = "",
        on_frame: Callable[[], None] = lambda: None,
    ):  # fmt: skip
        self.entries = [run if isinstance(run, Entry) else Entry(spec=run) for run in runs]
        self._store, self._jobs, self._dask, self._on_frame = store, jobs, dask, on_frame
        self._results: dict[int, RunResult] = {}
        self._inner: Generator[RunResult, None, None] | None = None
        self._wish = threading.Condition()
        self._go, self._stop = True, False
        self.now = ""
        """The run that is being done, in words."""
        self.is_resting = False
        """Whether a run waits between two frames."""

    @property
    def results(self) -> list[RunResult]:
        """Results so far, in the order of the runs."""
        return [result for _, result in sorted(self._results.copy().items())]

    def let(self, *, go: bool, stop: bool = False) -> None:
        """Let runs go on, or wait after the current frame, or end after it."""
        with self._wish:
            self._go, self._stop = go, stop
            self._wish.notify_all()

    def close(self) -> None:
        """Release processes; the next step starts them again."""
        inner, self._inner = self._inner, None
        if inner is not None:
            inner.close()
        self.now = ""

    def __next__(self) -> RunResult | None:
        if self._inner is None:
            self._inner = self._rest()
        try:
            return next(self._inner)
        except BaseException as e:  # a generator that raised cannot continue, and the next step makes another
            self._inner = None
            if isinstance(e, _Stopped):
                return None
            raise

    def _rest(self) -> Generator[RunResult, None, None]:
        """The runs without a result."""
        left = [i for i in range(len(self.entries)) if i not in self._results]
        alone = self._jobs == 1 and not self._dask
        with contextlib.nullcontext(InProcess(self._on_step)) if alone else executor(self._jobs, self._dask) as where:
            for i, result in run_all([self.entries[i] for i in left], self._store, where):
                self._results[left[i]] = result
                yield result

    def _on_step(self, task: Task, report: StepReport | None) -> None:
        """Called between two frames: wait while paused.

        Raises:
            _Stopped: the run is to be given up.
        """
        spec, kind = task.spec, "tuning " if task.kind == "tune" else ""
        work = "optimising and scoring" if report is None else f"frame {report.frame_index}"
        self.now = f"{kind}{spec.label}, {spec.scene}, {spec.budget}, seed {spec.seed}, {work}"
        self.is_resting = not (self._go or self._stop)
        self._on_frame()
        with self._wish:
            self._wish.wait_for(lambda: self._go or self._stop)
            self.is_resting = False
        if self._stop:
            raise _Stopped


@functools.cache
def _front_end() -> str:
    return fill("table_widget.js")


class TableWidget(anywidget.AnyWidget):
    """Shows a ``ResultTable``; a click on a heading sorts, a click on a row sets ``selected`` to its label
    or, the second time, to ""."""

    _esm = _front_end()

    content: Any = t.Dict({"title": "", "heads": [], "rows": []}).tag(sync=True)
    selected: Any = t.Unicode("").tag(sync=True)

    def show(self, table: ResultTable, states: Mapping[str, str]) -> None:
        """Show another table.

        Args:
            table: The table; its order is that of the rows until a heading is clicked.
            states: Label -> short text beside it, such as "2 of 3 runs".
        """
        heads = [{"name": "rule", "better": "neither"}]
        heads += [{"name": column.name, "better": column.better} for column in table.columns]
        rows = [
            {"label": row.label, "state": states.get(row.label, ""), "cells": [_plain(cell) for cell in row.cells]}
            for row in table.rows
        ]
        content = {"title": table.title, "heads": heads, "rows": rows}
        if content != self.content:
            self.content = content


def _plain(cell: Cell) -> dict[str, Any]:
    value = None if not math.isfinite(cell.value) else cell.value
    return {"mean": cell.mean, "sd": cell.sd, "place": cell.place, "value": value}


MIN_INTERVAL_S = 0.1
"""The line with the state is written at most ten times a second."""

_on_stage: "weakref.ref[LiveTable] | None" = None


class LiveTable:
    """Does runs in a thread of its own and shows their results as they come; other cells can run meanwhile.

    The last line of a cell shows it: a table of one scene and budget, which a click on a heading sorts; a click on a
    rule shows its held-out views. From Python: ``start``, ``pause``, ``step``, ``stop``, and ``run_sync(n)``, which
    does ``n`` runs in the calling cell. Results are kept in ``folder``, and a run that is done is never repeated: the
    same table made again has its rows at once. Making another ``LiveTable`` stops this one.

    Args:
        runs: What is compared; ``entries_of`` makes all combinations of rules, scenes, seeds and budgets.
        folder: Where results and pictures are kept.
        jobs: Number of processes; with 1 the runs are done in this process and pause between two frames, with more
            they pause between two runs.
        dask: As for ``executors.executor``.

    ``results`` are those so far. ``write()`` writes runs.csv, provenance.json, tables, figures and the page into
    ``folder``.
    """

    def __init__(
        self, runs: Iterable[Entry | RunSpec], folder: str | Path | ResultStore = "runs/lab", *,
        jobs: int = 1, dask: str = "",
    ):  # fmt: skip
        global _on_stage
        if _on_stage is not None and (earlier := _on_stage()) is not None:
            earlier.stop()
        _on_stage = weakref.ref(self)
        self.store = folder if isinstance(folder, ResultStore) else ResultStore(folder)
        self._runs = LiveRuns(runs, self.store, jobs=jobs, dask=dask, on_frame=self._on_frame)
        self.player = Player(lambda: self._runs, on_step=self._on_run, on_rest=self._on_rest)
        self._writing = threading.RLock()
        self._next_write_s = 0.0
        self._build()
        self._show_table()
        self._write_status()

    @property
    def results(self) -> list[RunResult]:
        """Results so far, in the order of the runs."""
        return self._runs.results

    def start(self) -> None:
        """Run until paused, stopped or done."""
        self._runs.let(go=True)
        self.player.start()
        self._write_status()

    def pause(self) -> None:
        """Pause after the current frame; with several processes, after the current run."""
        self._runs.let(go=False)
        self.player.pause()
        self._write_status()

    def step(self) -> None:
        """Do one run, or the rest of the current one."""
        self._runs.let(go=True)
        self.player.step()

    def stop(self) -> None:
        """Give up the current run; ``start`` begins with it again."""
        self._runs.let(go=False, stop=True)
        self.player.stop()
        self._write_status()

    def run_sync(self, n: int | None = None) -> int:
        """Do ``n`` runs, or all that are left, in this thread. Returns how many results came."""
        self._runs.let(go=False, stop=True)
        self.player.close()
        self._runs.let(go=True)
        before = len(self.results)
        self.player.run_sync(n)
        return len(self.results) - before

    def join(self, timeout_s: float | int | None = None) -> bool:
        """Wait until the thread has ended. Returns whether it has."""
        return self.player.join(timeout_s)

    def close(self) -> None:
        """Stop, and wait until the thread has ended."""
        self.stop()
        self.player.join(30.0)

    def table(self) -> ResultTable:
        """The table that is shown."""
        return scene_table(self._shown(), title=f"{self.scene.value}, {self.budget.value}")

    def figure(self) -> Any:
        """The Pareto plot of the scene and budget shown: quality over size, or where the budget gives every rule
        the same size, over the time per frame."""
        groups = self._shown()
        cost = "ms_per_frame" if any(group.fixes_cost for group in groups) else "n_gaussians"
        return pareto_figure(scene_points(groups, cost))

    def picture(self) -> Picture:
        """The Pareto plot as an image."""
        return figure_picture(self.figure())

    def write(self, folder: str | Path | None = None) -> list[Path]:
        """Write what ``gsfusion-nb lab`` writes about the results so far: ``write_outputs``.

        Args:
            folder: Where the files go; into the folder of the results if None.

        Returns:
            The files written.
        """
        return write_outputs(Path(folder or self.store.folder), self.results)

    def __repr__(self) -> str:
        reasons = [reason for *_, reason in failures(self.results)]
        failed = f", {len(reasons)} failed: {reasons[0]}" if reasons else ""
        return f"LiveTable({len(self.results)} of {len(self._runs.entries)} runs{failed})"

    def _repr_mimebundle_(self, **kwargs: Any) -> Bundle:
        self._show_table()
        self._write_status()
        figure = self.figure()
        picture = figure_picture(figure)
        alt = figure_words(figure)
        data, words = with_picture(self.widget._repr_mimebundle_(**kwargs), picture, repr(self), alt=alt)
        values = {"tables": all_tables(self.results), "failures": failures(self.results)}
        data["text/html"] = fill("live_table.html", **values, picture=data_uri(picture, "png"))
        return data, words

    @property
    def _place(self) -> tuple[str, str]:
        """Scene and budget that are shown."""
        return str(self.scene.value), str(self.budget.value)

    def _shown(self) -> list[Group]:
        return [g for g in group_runs(self.results) if (g.scene, g.budget) == self._place]

    def _on_frame(self) -> None:
        if self._runs.is_resting or time.monotonic() >= self._next_write_s:
            self._next_write_s = time.monotonic() + MIN_INTERVAL_S
            self._write_status()

    def _on_run(self, _result: Any) -> None:
        self._show_table()
        self._write_status()

    def _on_rest(self) -> None:
        if self.player.state in ("stopped", "finished", "failed"):
            self._runs.close()
        self._show_table()
        self._write_status()

    def _show_table(self) -> None:
        with self._writing:
            place = self._place
            specs = [entry.spec for entry in self._runs.entries]
            planned = Counter(spec.label for spec in specs if (spec.scene, str(spec.budget)) == place)
            states = {}
            for group in self._shown():
                n, lost = planned[group.label], len(group.failed)
                done = f"{len(group.runs)} of {n} runs" if len(group.runs) < n else ""
                states[group.label] = f"{done}, {lost} failed" if lost else done
            self.widget_table.show(self.table(), states)
            seeds: dict[tuple[str, str], list[int]] = {}
            for label, scene, budget, seed, reason in failures(self.results):
                if (scene, budget) == place:
                    seeds.setdefault((label, reason), []).append(seed)
            lines = [
                f"{label}, seed{'s' * (len(of) > 1)} {', '.join(map(str, of))}: {reason}"
                for (label, reason), of in seeds.items()
            ]
            self.failed.value = "<br>".join(html.escape(line) for line in lines)

    def _show_pictures(self, _change: Any = None) -> None:
        with self._writing:
            self.pictures.value = self._pictures_of(self.widget_table.selected)

    def _pictures_of(self, label: str) -> str:
        """The held-out views of a rule at the scene and budget shown, as HTML."""
        for run in next((g.runs for g in self._shown() if g.label == label), ()):
            pictures = [
                shown
                for view in views_of(run, self.store.folder)
                for shown in (
                    (f"view {view.name}, recorded", f"View {view.name} as recorded", data_uri(view.truth)),
                    (label, f"View {view.name} as rendered by {label}", data_uri(view.render)),
                    ("error", f"Error of {label} in view {view.name}", data_uri(view.error)),
                )
            ]
            if pictures:
                return fill("view_pictures.html", label=label, seed=run.spec.seed, pictures=pictures)
        return html.escape(f"{label}: no pictures") if label else ""

    def _write_status(self) -> None:
        """Show the state of now. Called from two threads: who writes last must also be who read the state last."""
        with self._writing:
            state = "paused" if self._runs.is_resting and self.player.state == "running" else self.player.state
            words = [f"<b>{state}</b>", f"{len(self.results)} of {len(self._runs.entries)} runs"]
            if state in ("running", "paused"):
                words.append(html.escape(self._runs.now))
            error = self.player.error
            if error is not None:
                words.append(f'<span style="color:#b3261e">{html.escape(f"{type(error).__name__}: {error}")}</span>')
            self.progress.value = len(self.results)
            self.status.value = " · ".join(word for word in words if word)

    def _build(self) -> None:
        import ipywidgets as w

        self.buttons = player_buttons(self, "gsnb-lab", self.player)
        self.progress = w.IntProgress(min=0, max=max(len(self._runs.entries), 1), layout=w.Layout(width="260px"))
        self.status, self.failed, self.pictures = w.HTML(), w.HTML(), w.HTML()
        self.status.add_class("gsnb-lab-status")
        self.pictures.add_class("gsnb-lab-pictures")
        self.failed.add_class("gsnb-lab-failed")
        specs = [entry.spec for entry in self._runs.entries]
        scenes = list(dict.fromkeys(s.scene for s in specs))
        budgets = list(dict.fromkeys(str(s.budget) for s in specs))
        self.scene = w.Dropdown(options=scenes, description="Scene")
        self.budget = w.Dropdown(options=budgets, description="Budget", layout=w.Layout(width="360px"))
        for menu in (self.scene, self.budget):
            menu.observe(lambda _: self._place_changed(), names="value")
        self.widget_table = TableWidget()
        self.widget_table.observe(self._show_pictures, names="selected")
        row = w.Layout(flex_flow="row wrap")
        controls = w.HBox([*self.buttons.values(), self.progress], layout=row)
        menus = w.HBox([self.scene, self.budget], layout=row)
        parts = [controls, self.status, menus, self.widget_table, self.failed, self.pictures]
        self.widget = w.VBox(parts)
        self.widget.add_class("gsnb-lab")

    def _place_changed(self) -> None:
        self._show_table()
        self._show_pictures()
