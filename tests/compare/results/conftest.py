"""Made results of runs, for the tests of what the lab writes about them."""

import itertools

import cv2
import numpy as np
import pytest

from gsfusion_nb.compare import Budget, RunResult, RunSpec
from gsfusion_nb.compare.outputs import Results
from gsfusion_nb.compare.run_all import ResultStore


@pytest.fixture(scope="session")
def made_run():
    """A function that makes the result of one run from its place and a few numbers."""

    def make(
        label,
        scene="room",
        seed=0,
        psnr=24.0,
        *,
        budget=None,
        failed="",
        notes=(),
        pictures=None,
        **metrics,
    ):
        spec = RunSpec(
            rule="uniform",
            label=label,
            scene=scene,
            data="room",
            seed=seed,
            budget=budget or Budget(),
        )
        if failed:
            return RunResult(spec=spec, status="failed", reason=failed)
        numbers = {
            "psnr_held_out_db": float(psnr),
            "psnr_mapped_db": psnr + 2.0,
            "n_gaussians": 4000.0,
            "n_steps": 200.0,
        }
        return RunResult(
            spec=spec,
            status="done",
            metrics=numbers | metrics,
            notes=list(notes),
            pictures=pictures or {},
            map_hash=f"map-{label}-{scene}-{seed}",
            data_hash=f"data-{scene}",
            rule_source=f"def {label}(ctx): ...",
            versions={"gsfusion_nb": "0.1.0", "torch": "2.6"},
        )

    return make


@pytest.fixture(scope="session")
def made_runs(made_run):
    """A function that makes the runs of a rule from scene -> PSNR of each seed."""

    def make(label, by_scene, **more):
        places = [(scene, seed, db) for scene, of in by_scene.items() for seed, db in enumerate(of)]
        return [made_run(label, *place, **more) for place in places]

    return make


@pytest.fixture(scope="session")
def made_results(made_run):
    """A function from a folder to 3 rules x 2 scenes x 3 seeds x 2 budgets in it, with pictures;
    one run has failed."""
    rules = {
        "quadtree": (24.8, 3000),
        "uniform": (24.4, 1500),
        "every <pixel> & more": (22.0, 9000),
    }

    def make(folder):
        folder.mkdir(parents=True, exist_ok=True)
        noise = np.random.default_rng(0)
        results = []
        for budget, scene, label, seed in itertools.product(
            (Budget(gaussians=4000), Budget(steps="own")),
            ("room", "kitchen"),
            rules,
            range(3),
        ):
            psnr, n = rules[label]
            if (label, scene, seed) == ("uniform", "kitchen", 2):
                results.append(
                    made_run(label, scene, seed, budget=budget, failed="ValueError: <no> seeds")
                )
                continue
            size = 4000 + noise.integers(-100, 100) if budget.gaussians else n + 10 * seed
            stem = f"{label.split()[0]}-{scene}-{budget.steps}"
            run = made_run(
                label,
                scene,
                seed,
                psnr + float(noise.normal(0, 0.05)),
                budget=budget,
                n_gaussians=float(size),
                ms_per_frame=40 + n / 200 + float(noise.normal(0, 2)),
                ssim_held_out=0.8,
                depth_l1_held_out_m=0.021,
                peak_memory_mb=1200.0,
                pictures={} if seed else _pictures(folder, stem, psnr),
            )
            results.append(run)
        return results

    return make


@pytest.fixture(scope="session")
def written(made_results, tmp_path_factory):
    """The files of ``made_results``."""
    folder = tmp_path_factory.mktemp("lab")
    return Results(runs=made_results(folder), store=ResultStore(folder)).write(folder)


@pytest.fixture(scope="session")
def folder(written):
    """Where they are."""
    return written[0].parent


def _pictures(folder, stem, psnr):
    """Two views: a coloured gradient with more or less noise, and the truth."""
    names = {}
    noise = np.random.default_rng(1)
    columns, rows = np.meshgrid(np.linspace(40, 200, 64), np.linspace(60, 220, 48))
    for view in (4, 9):
        truth = np.stack(
            [columns, rows, np.full((48, 64), 20.0 * view)],
            axis=2,
        )
        render = truth + noise.normal(
            0,
            255 * 10 ** (-psnr / 20),
            truth.shape,
        )
        for name, image in ((f"truth {view}", truth), (f"held_out {view}", render)):
            names[name] = f"{stem}-{name.replace(' ', '-')}.jpg"
            cv2.imwrite(
                str(folder / names[name]),
                np.clip(image, 0, 255).astype(np.uint8),
            )
    return names
