import contextlib
import os
import subprocess
import sys

import pytest
import torch

from gsfusion_nb import backends
from gsfusion_nb.backends import dispatch, offers
from gsfusion_nb.cli import doctor


@pytest.fixture
def dispatched(monkeypatch):
    """Operations that ran, in order."""
    ran = []
    real = dispatch._implementation

    def select(name, args, kwargs):
        ran.append(name)
        return real(name, args, kwargs)

    monkeypatch.setattr(dispatch, "_implementation", select)
    return ran


@contextlib.contextmanager
def watching():
    """Names of our functions that numba compiles inside the block, as they come."""
    from numba.core import event

    names = []

    class Listener(event.Listener):
        def on_start(self, event):
            function = event.data["dispatcher"].py_func
            if function.__module__.startswith("gsfusion_nb.kernels"):
                names.append(f"{function.__module__.split('.')[-2]}.{function.__name__}")

        def on_end(self, event):
            pass

    with event.install_listener("numba:compile", Listener()):
        yield names


def test_progress_names_every_map_and_ends_at_the_total(monkeypatch, capsys):
    pytest.importorskip("numba")
    mapped = []
    shown = []
    threads = torch.get_num_threads()
    monkeypatch.setattr(doctor, "_map", mapped.append)
    monkeypatch.setattr(
        doctor.ProgressDisplay, "show", lambda self, done, **more: shown.append((done, more))
    )
    assert doctor.warm() == 0
    assert [done for done, _ in shown] == list(range(len(mapped) + 1))
    assert [more.get("note", "") for _, more in shown] == [
        *(type(config).__name__ for config in mapped),
        "",
    ]
    assert torch.get_num_threads() == threads
    assert "All fast kernels are compiled" in capsys.readouterr().out


@pytest.mark.ci
def test_the_maps_use_every_compiled_operation_and_nothing_is_compiled_again(dispatched):
    pytest.importorskip("numba")
    assert doctor.warm() == 0
    fast = {
        name for name in backends.operations() if backends.automatic(name, "cpu") != "reference"
    }
    # the kernels of new_band_blocks, and a step that a system of one's own takes by itself
    assert fast - set(dispatched) == {"band_blocks", "adam_update"}
    with watching() as compiled:
        assert doctor.warm() == 0
    assert compiled == []


def test_without_fast_backends_there_is_nothing_to_do(monkeypatch, capsys):
    monkeypatch.setattr(offers, "offered", lambda name: ())
    # nothing is remembered
    monkeypatch.setattr(backends, "automatic", backends.automatic.__wrapped__)
    assert doctor.warm() == 1
    assert "nothing to compile" in capsys.readouterr().out


_ONE_KERNEL = """
import torch
torch.set_num_threads(1)
from gsfusion_nb.backends import is_compiled
from gsfusion_nb.optim import adam_update
print(is_compiled("adam_update"))
for _ in range(2):
    x = torch.zeros(3, 2)
    adam_update(x, x.clone(), x.clone(), x.clone(), None, lr=0.1, beta1=0.9, beta2=0.999, eps=1e-8)
print(torch.get_num_threads())
from gsfusion_nb.compile_clock import COMPILE_CLOCK
print(COMPILE_CLOCK.seconds > 0, is_compiled("adam_update"))
"""


@pytest.mark.ci
def test_compiling_is_announced_once_and_only_when_it_happens(tmp_path):
    pytest.importorskip("numba")
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path), "GSFUSION_BACKEND": "auto"}
    command = [sys.executable, "-c", _ONE_KERNEL]
    first, second = (
        subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
        for _ in range(2)
    )
    assert (
        first.stderr.count(
            "compiling the numba kernels that this command needs (once on this machine"
        )
        == 1
    )
    assert second.stderr == ""
    # numba's OpenMP layer sets the thread count of the runtime that it shares with torch; it must
    # be put back
    assert first.stdout.split() == ["False", "1", "True", "True"]
    assert second.stdout.split() == ["True", "1", "False", "True"]
