"""Operations check what they are given before they touch memory, with the same sentence on every
backend."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from kernel_cases import make_frame, make_params
from kernel_cases.rasterize import break_rows

from gsfusion_nb.backends import use_backend
from gsfusion_nb.config import OptimConfig
from gsfusion_nb.gaussians import GaussianModel
from gsfusion_nb.optim import adam_step
from gsfusion_nb.render import render_forward, render_vjp
from gsfusion_nb.types import GaussianParams, Seeds

SCRIPT = Path(__file__).with_name("bad_operands.py")


def outcomes(
    *backends: str,
    **environment: str,
) -> dict[str, dict[str, str | list[list[float]]]]:
    """What ``bad_operands.py`` printed; the process must have lived to the end."""
    done = subprocess.run(
        [sys.executable, "-P", "-W", "ignore", str(SCRIPT), *backends],
        env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path)), **environment},
        capture_output=True,
        text=True,
        timeout=600,
    )
    assert done.returncode == 0, f"{backends} ended with {done.returncode}: {done.stderr[-3000:]}"
    return json.loads(done.stdout)


@pytest.fixture(scope="module")
def on_the_processor():
    """Backend -> its outcomes, of one process for all: starting takes as long as the cases of
    one."""
    return outcomes("reference", "numba")


@pytest.fixture(scope="module")
def expected(on_the_processor):
    return on_the_processor["reference"]


def differences(found: dict, expected: dict, share: float = 1e-3) -> list[str]:
    """Cases in which two backends say or make something else."""
    wrong = []
    for case, value in found.items():
        wanted = expected[case]
        if isinstance(value, str) or isinstance(wanted, str):
            same = value == wanted
        else:
            pairs = list(zip(value, wanted, strict=True))
            same = all(
                n == m and abs(a - b) <= share * max(1.0, abs(b)) for (n, a), (m, b) in pairs
            )
        if not same:
            wrong.append(f"{case}: {value}, expected {wanted}")
    return wrong


def test_every_mistake_is_refused_in_one_sentence(expected):
    """Nothing but ValueError, and the sentence begins with the operation wherever the operation
    says it."""
    assert len(expected) > 900
    assert not [
        case
        for case, said in expected.items()
        if isinstance(said, str) and "and no ValueError" in said
    ]
    for case in (c for c in expected if c.endswith(": as it should be")):
        operation = case.split(":")[0]
        assert not isinstance(expected[case], str), case
        with_gaps = {
            c: v
            for c, v in expected.items()
            if c.startswith(f"{operation}: ") and c.endswith("with gaps")
        }
        assert not differences(with_gaps, dict.fromkeys(with_gaps, expected[case])), (
            "gaps change nothing"
        )


def test_same_on_numba(expected, on_the_processor):
    found = on_the_processor["numba"]
    assert len(found) == len(expected)
    assert not differences(found, expected)


@pytest.mark.slow
def test_same_from_the_cuda_kernels_on_the_processor(emulator_library, expected):
    found = outcomes("cuda", GSFUSION_CUDA_EMULATOR=str(emulator_library))["cuda"]
    assert len(found) > 200
    assert not differences(found, expected)


@pytest.mark.parametrize("backend", ["reference", "numba"])
def test_broken_gaussians_are_not_drawn_and_have_no_gradient(backend):
    frame = make_frame()
    params = make_params(1, "cpu")
    whole = make_params(1, "cpu")
    n = break_rows(params)
    results = []
    with use_backend(backend):
        for given in (params, whole[torch.arange(n, len(whole))]):
            out, saved = render_forward(given, frame.camera, frame.T_WC)
            results.append(
                (
                    out.rgb,
                    render_vjp(
                        saved,
                        torch.ones_like(out.rgb),
                        torch.ones_like(out.depth_m),
                    ),
                )
            )
    torch.testing.assert_close(
        results[0][0],
        results[1][0],
        rtol=1e-5,
        atol=1e-6,
    )
    for name, gradient in vars(results[0][1]).items():
        assert not gradient[:n].any(), name
        torch.testing.assert_close(
            gradient[n:],
            getattr(results[1][1], name),
            rtol=1e-4,
            atol=1e-3,
        )


def test_too_many_pairs_are_refused(monkeypatch):
    module = pytest.importorskip("gsfusion_nb.kernels.binning.layout")
    monkeypatch.setattr(module, "MOST_PAIRS", 10)
    frame = make_frame()
    with (
        use_backend("numba"),
        pytest.raises(ValueError, match=r"pairs are more than 2\^31; draw a smaller image"),
    ):
        render_forward(make_params(0, "cpu"), frame.camera, frame.T_WC)


def test_a_gradient_of_another_map_changes_nothing():
    """All columns are looked at before the first one is updated."""
    model = GaussianModel(sh_degree=0)
    model.append(
        Seeds.isotropic(torch.ones(4, 3), torch.rand(4, 3), torch.full((4,), 0.1)),
        0,
    )
    before = {name: column.clone() for name, column in vars(model.params).items()}
    gradients = {name: torch.ones_like(column) for name, column in before.items()}
    with pytest.raises(ValueError, match=r"sh must be \[4, 1, 3\], got \[3, 1, 3\]"):
        adam_step(
            model,
            _unchecked(gradients | {"sh": gradients["sh"][:3]}),
            OptimConfig(),
        )
    assert all(torch.equal(column, before[name]) for name, column in vars(model.params).items())
    assert model.clock.count == 0


def _unchecked(columns: dict[str, torch.Tensor]) -> GaussianParams:
    """Made without the shape check that the tests' type checker adds."""
    params = object.__new__(GaussianParams)
    for name, column in columns.items():
        object.__setattr__(params, name, column)
    return params
