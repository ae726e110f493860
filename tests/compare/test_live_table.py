"""The live table: rows as runs end, pause between two frames, stop and go on, pictures of a row,
and what is stored."""

import time

import pytest

from gsfusion_nb.compare import Budget
from gsfusion_nb.compare.entries import Entrant, entries_of
from gsfusion_nb.compare.live_table import LiveTable
from gsfusion_nb.compare.map_scene import Entry
from gsfusion_nb.compare.run_all import ResultStore
from gsfusion_nb.viz.display import WIDGET_MIME


@pytest.fixture(scope="module")
def cache(tmp_path_factory):
    return tmp_path_factory.mktemp("cache")


@pytest.fixture
def specs(spec):
    """Two rules with two seeds; the last run fails."""
    own = Budget(steps="own")
    made = [spec("uniform", seed=seed, budget=own) for seed in (0, 1)]
    return [
        *made,
        spec("gsfusion", label="quadtree", budget=own),
        spec("dense", options={"stride": -1}, budget=own),
    ]


@pytest.fixture
def live(specs, tmp_path, cache):
    live = LiveTable(specs, tmp_path, store=ResultStore(cache))
    yield live
    live.close()


def wait_for(condition, timeout_s=20.0):
    until = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < until
        time.sleep(0.005)


def test_rows_appear_as_runs_end(live):
    assert "uniform" not in live.tables.value
    assert live.run_sync(1) == 1
    assert "uniform</th>" in live.tables.value
    assert "1 of 4 runs" in live.status.value
    assert live.run_sync() == 3
    assert all(
        f"{name}</th>" in live.tables.value for name in ("uniform", "quadtree", "dense stride=-1")
    )
    assert " ± " in live.tables.value
    assert "dense stride=-1, wall, own size, own steps, seed 0 failed: " in live.tables.value
    assert "<b>finished</b>" in live.status.value
    assert repr(live).startswith(
        "LiveTable(4 of 4 runs, 1 failed: KindError: seeding rule 'dense' has no options"
    )


@pytest.mark.ci
def test_it_starts_pauses_between_frames_goes_on_and_stops(specs, tmp_path):
    live = LiveTable(specs, tmp_path, store=ResultStore(tmp_path / "cache"))  # nothing is known yet
    live.start()
    wait_for(lambda: "frame" in live._activity)
    live.pause()
    wait_for(lambda: "<b>paused</b>" in live.status.value)
    n = len(live.results)
    now = live._activity
    time.sleep(0.1)
    assert (len(live.results), live._activity) == (n, now)
    live.stop()
    assert live.join(20)
    assert "<b>stopped</b>" in live.status.value
    assert len(live.results) == n
    live.start()
    assert live.join(60)
    assert "<b>finished</b>" in live.status.value
    assert len(live.results) == 4


@pytest.mark.ci
def test_another_table_stops_this_one_and_finds_its_results(live, specs, cache, tmp_path):
    live.run_sync(2)
    live.start()
    again = LiveTable(specs, tmp_path / "other", store=ResultStore(cache))
    assert live.join(20)
    assert again.run_sync(2) == 2
    assert [r.map_hash for r in again.results] == [r.map_hash for r in live.results[:2]]


def test_step_does_one_run(live):
    live.step()
    wait_for(lambda: live.player.state == "paused")
    assert len(live.results) == 1


def test_a_stored_notebook_has_table_and_picture(live, monkeypatch):
    live.run_sync()
    monkeypatch.setenv("GSNB_VIEW", "static")
    bundle = live._repr_mimebundle_()[0]
    assert WIDGET_MIME not in bundle
    assert "quadtree</th>" in bundle["text/html"]
    assert "stride=-1, wall, own size, own steps, seed 0 failed:" in bundle["text/html"]
    assert bundle["image/png"]
    assert bundle["text/plain"] == repr(live)


@pytest.mark.ci
def test_interrupting_the_kernel_keeps_what_is_done(specs, tmp_path, monkeypatch):
    live = LiveTable(specs[:2], tmp_path, store=ResultStore(tmp_path / "cache"))
    live.run_sync(1)
    monkeypatch.setattr(
        live._go,
        "wait",
        lambda: (_ for _ in ()).throw(KeyboardInterrupt),
    )
    with pytest.raises(KeyboardInterrupt):
        live.run_sync()
    monkeypatch.undo()
    assert live.run_sync() == 1
    assert {path.name for path in live.write()} >= {"table.md", "page.html"}


def test_all_combinations():
    def own(ctx):
        return ctx.cells()

    entries = entries_of(
        ["uniform", Entrant(own, label="mine")],
        ["room", "hall"],
        seeds=(0, 1),
        settings={"sh_degree": 0},
    )
    places = [(e.spec.scene, e.spec.label, e.spec.seed) for e in entries]
    assert places[:4] == [
        ("room", "uniform", 0),
        ("room", "uniform", 1),
        ("room", "mine", 0),
        ("room", "mine", 1),
    ]
    assert len(places) == 8
    assert entries[2].rule is own
    assert entries[2].spec.code
    assert not entries[0].spec.code
    assert entries[0].spec.settings == {"sh_degree": 0}
    with pytest.raises(ValueError, match="uniform"):
        entries_of(["uniform", "uniform"])
    with pytest.raises(KeyError, match="unifrom"):
        entries_of(["unifrom"])


def takes_numbers(ctx, *, step=7, scale=1.0):
    return ctx.seeds_at(ctx.pixels()[::step], 1.0)


@pytest.mark.parametrize(
    ("entrant", "shared", "message"),
    [
        (
            Entrant(takes_numbers, {"stepp": 3}),
            {},
            "has no options ['stepp']; known: ['scale', 'step']",
        ),
        (
            Entrant(takes_numbers),
            {},
            "the rule takes_numbers has no size option: name the option that changes",
        ),
        (
            Entrant(takes_numbers, size_option="stepp"),
            {},
            "takes_numbers has no option 'stepp' to tune; known: step",
        ),
        (
            Entrant(takes_numbers, size_option="step", size_range=(9, 2)),
            {},
            "both above 0, got [9, 2]",
        ),
        (
            Entrant("uniform"),
            {"settings": {"data.widht": 3}},
            "data: unknown keys ['widht']; known: ",
        ),
    ],
)
def test_mistakes_in_a_notebook_are_found_before_anything_runs(entrant, shared, message):
    with pytest.raises((ValueError, TypeError)) as error:
        entries_of(
            [entrant],
            budgets=[Budget(steps="own"), Budget(gaussians=150)],
            **shared,
        )
    assert message in str(error.value)


@pytest.mark.ci
def test_settings_and_open_frames_of_a_notebook(specs, tmp_path, cache):
    config = specs[0].config()
    sequence = Entry(spec=specs[0]).opened()
    rules = ["uniform", Entrant("uniform", {"fraction": 0.05})]
    entries = entries_of(
        rules,
        [sequence],
        seeds=(0, 1),
        budgets=[Budget(steps="own")],
        config=config,
    )
    assert [e.spec.scene for e in entries] == ["wall"] * 4
    assert entries[0].spec.config().tsdf == config.tsdf
    assert entries[1].spec.config().seed == 1
    live = LiveTable(entries, tmp_path, store=ResultStore(cache))
    assert live.run_sync(1) == 1
    assert repr(live) == "LiveTable(1 of 4 runs)"
    by_name = entries_of(
        ["uniform"],
        [specs[0].data],
        seeds=[0],
        budgets=[Budget(steps="own")],
        config=config,
    )
    again = LiveTable(by_name, tmp_path / "by_name", store=ResultStore(cache))
    again.run_sync()
    assert again.results[0].map_hash == live.results[0].map_hash
