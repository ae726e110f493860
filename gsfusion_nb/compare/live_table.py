"""A comparison in a notebook: a table that fills while the runs are done, with buttons."""

import html
import threading
import time
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from ..checks import check_name
from ..drawing.curves import figure_picture, figure_words
from ..drawing.encoding import encode_palette
from ..drawing.page import fill
from ..drawing.pictures import Picture
from ..mapping import StepReport
from ..viz.display import Bundle, LiveOutput, with_stored
from ..viz.player import MIN_INTERVAL_S, Player, error_html, player_buttons, take_the_stage
from .executors import InProcess, Task
from .map_scene import Entry
from .outputs import Results, Table
from .run_all import ResultStore, run_all
from .run_result import RunResult
from .spec import RunSpec
from .tables import failures


class _Stopped(BaseException):
    """Raised between two frames of a run that is given up; no ``except Exception`` holds it
    back."""


class LiveTable(LiveOutput):
    """Does runs in a thread of its own and shows their results as they come; other cells can run
    meanwhile.

    The last line of a cell shows it. From Python: ``start``, ``pause``, ``step``, ``stop``, and
    ``run_sync(n)``, which does ``n`` runs in the calling cell. Results are kept in a cache, and a
    run that is done is never repeated: the same table made again has its rows at once. Making
    another ``LiveTable`` stops this one.

    Args:
        runs: What is compared; ``entries_of`` makes all combinations of rules, scenes, seeds and
            budgets.
        folder: Where ``write`` writes.
        store: Where results are kept; the cache of this package by default.
        reference: Label of the rule that all others are tested against. It must not be chosen by
            the results. By default ``gsfusion`` where it takes part, else the first.

    ``results`` are those so far. ``write()`` writes the table, the figure and the page into
    ``folder``.
    """

    def __init__(
        self,
        runs: Iterable[Entry | RunSpec],
        folder: str | Path = "runs/lab",
        *,
        store: ResultStore | None = None,
        reference: str = "",
    ):
        take_the_stage(self)
        self.entries = [run if isinstance(run, Entry) else Entry(spec=run) for run in runs]
        self._about = Table(specs=[entry.spec for entry in self.entries], reference=reference)
        if reference:
            check_name("rule", reference, dict.fromkeys(spec.label for spec in self._about.specs))
        self.folder = Path(folder)
        self.store = store or ResultStore()
        self._results: dict[int, RunResult] = {}
        self._go = threading.Event()
        self._given_up = False
        self._resting = False
        self._activity = ""
        self._go.set()
        self._writing = threading.RLock()
        self._next_write_s = 0.0
        self.player = Player(
            self._runs,
            on_step=lambda _: self._show(),
            on_rest=self.store_output,
        )
        self._build()
        self._show()

    @property
    def results(self) -> list[RunResult]:
        """Results so far, in the order of the runs."""
        return [result for _, result in sorted(self._results.copy().items())]

    def start(self) -> None:
        """Run until paused, stopped or done."""
        self._permit()
        self.player.start()

    def pause(self) -> None:
        """Pause after the current frame."""
        self._go.clear()
        self.player.pause()
        self._say()

    def step(self) -> None:
        """Do one run, or the rest of the current one."""
        self._permit()
        self.player.step()

    def stop(self) -> None:
        """Give up the current run; ``start`` begins with it again."""
        self._given_up = True
        self._go.set()
        self.player.stop()
        self._say()

    def run_sync(self, n: int | None = None) -> int:
        """Do ``n`` runs, or all that are left, in this thread. Returns how many results came."""
        self.close()
        self._permit()
        n_results = len(self._results)
        self.player.run_sync(n)
        return len(self._results) - n_results

    def join(self, timeout_s: float | int | None = None) -> bool:
        """Wait until the thread has ended. Returns whether it has."""
        return self.player.join(timeout_s)

    def close(self) -> None:
        """Stop, and wait until the thread has ended."""
        self.stop()
        self.player.join(30.0)

    def picture(self) -> Picture:
        """The Pareto plot as an image."""
        return figure_picture(self._now_known().figure())

    def write(self, folder: str | Path | None = None) -> list[Path]:
        """Write the results so far (``Results.write``). Returns the files."""
        return self._now_known().write(folder or self.folder)

    def __repr__(self) -> str:
        reasons = [reason for *_, reason in failures(self.results)]
        failure_text = f", {len(reasons)} failed: {reasons[0]}" if reasons else ""
        return f"LiveTable({len(self._results)} of {len(self.entries)} runs{failure_text})"

    def _repr_mimebundle_(self, **kwargs: Any) -> Bundle:
        self._show()
        results = self._now_known()
        figure = results.figure()
        bundle = self.widget._repr_mimebundle_(**kwargs)
        data, words = with_stored(
            bundle,
            "image/png",
            encode_palette(figure_picture(figure)),
            repr(self),
            {"alt": figure_words(figure)},
        )
        data["text/html"] = results._repr_html_()
        return data, words

    def _now_known(self) -> Results:
        """The results so far, as results of this comparison."""
        return Results(runs=self.results, about=self._about, store=self.store)

    def _permit(self) -> None:
        """Let the runs go on."""
        self._given_up = False
        self._go.set()

    def _runs(self) -> Iterator[RunResult | None]:
        """The runs without a result; one step does one run, or gives None if it was given up."""
        while remaining := [i for i in range(len(self.entries)) if i not in self._results]:
            try:
                for i, result in run_all(
                    [self.entries[i] for i in remaining], self.store, InProcess(self._on_frame)
                ):
                    self._results[remaining[i]] = result
                    yield result
            except _Stopped:
                yield None

    def _on_frame(self, task: Task, report: StepReport | None) -> None:
        """Called between two frames: wait while paused.

        Raises:
            _Stopped: the run is to be given up.
        """
        spec = task.spec
        kind = "tuning " if task.kind == "tune" else ""
        work = "optimising and scoring" if report is None else f"frame {report.frame_index}"
        self._activity = (
            f"{kind}{spec.label}, {spec.scene}, {spec.budget}, seed {spec.seed}, {work}"
        )
        self._resting = not self._go.is_set()
        if self._resting or time.monotonic() >= self._next_write_s:
            self._next_write_s = time.monotonic() + MIN_INTERVAL_S
            self._say()
        self._go.wait()
        self._resting = False
        if self._given_up:
            raise _Stopped

    def _show(self) -> None:
        with self._writing:
            results = self._now_known()
            failure_texts = failures(results.runs)
            self.tables.value = fill(
                "live_table.html", tables=results.tables(), failures=failure_texts, picture=""
            )
            self.progress.value = len(results.runs)
            self._say()

    def _say(self) -> None:
        """Show the state of now. Called from two threads: who writes last must also be who read the
        state last."""
        with self._writing:
            state = (
                "paused" if self._resting and self.player.state == "running" else self.player.state
            )
            words = [f"<b>{state}</b>", f"{len(self._results)} of {len(self.entries)} runs"]
            if state in ("running", "paused"):
                words.append(html.escape(self._activity))
            self.status.value = " · ".join(words) + error_html(self.player.error)

    def _build(self) -> None:
        import ipywidgets as w

        self.buttons = player_buttons(self, "gsnb-lab", self.player)
        self.progress = w.IntProgress(
            min=0,
            max=max(len(self.entries), 1),
            layout=w.Layout(width="260px"),
        )
        self.status = w.HTML()
        self.tables = w.HTML()
        self.status.add_class("gsnb-lab-status")
        controls = w.HBox(
            [*self.buttons.values(), self.progress],
            layout=w.Layout(flex_flow="row wrap"),
        )
        self.widget = w.VBox([controls, self.status, self.tables])
        self.widget.add_class("gsnb-lab")
