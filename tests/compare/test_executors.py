"""Ctrl-C belongs to the process that started the others, also while these still import."""

import signal
import subprocess
import sys

import pytest

SCRIPT = """
import os, signal, sys, time
from gsfusion_nb.compare import executors

def pressed(task):
    os.kill(os.getpid(), signal.SIGINT)  # as the terminal does, to every process of the group
    time.sleep(0.05)
    return executors.Answer(reason="went on")

executors.do_sent_task = pressed
if __name__ == "__main__":
    with executors.executor(jobs=2) as where:
        where.put(0, executors.Task(kind="run", spec=None, backend="auto"))
        blocked = signal.pthread_sigmask(signal.SIG_BLOCK, [])
        print(where.get()[1].reason, signal.SIGINT in blocked)
else:  # in the process that was started, which imports
    os.kill(os.getpid(), signal.SIGINT)
    print("imported", flush=True)
"""


@pytest.mark.skipif(not hasattr(signal, "pthread_sigmask"), reason="Windows blocks no signals")
def test_a_process_that_is_started_takes_no_ctrl_c_while_it_imports(tmp_path):
    (tmp_path / "several.py").write_text(SCRIPT)
    done = subprocess.run(
        [sys.executable, str(tmp_path / "several.py")], capture_output=True, text=True
    )
    assert done.stderr == ""
    assert done.stdout.split() == ["imported", "went", "on", "False"]
