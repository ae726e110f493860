"""Whether VTK can draw on this machine, found out without risking the kernel."""

import functools
import importlib.util
import os
import subprocess
import sys

_PROBE = (
    "import pyvista as pv; p = pv.Plotter(off_screen=True, window_size=(16, 16)); "
    "p.add_mesh(pv.Sphere()); assert p.screenshot(return_img=True).shape[:2] == (16, 16)"
)


@functools.cache
def can_draw() -> tuple[bool, str]:
    """Whether a pyvista ``Plotter`` works on this machine, and the reason if not.

    On a machine with neither libgl1 nor libegl1 creating one ends the process with a segmentation fault that no ``try``
    catches, so it is tried once in a process of its own. The environment variable GSNB_VTK=ok or none skips the trial.
    """
    if importlib.util.find_spec("pyvista") is None:
        return False, "pyvista is not installed: pip install 'gsfusion-nb[pyvista]'"
    prepare()
    forced = os.environ.get("GSNB_VTK")
    if forced in ("ok", "none"):
        return forced == "ok", f"GSNB_VTK={forced}"
    try:
        done = subprocess.run([sys.executable, "-c", _PROBE], capture_output=True, text=True, timeout=60)
    except subprocess.TimeoutExpired:
        return False, "a 16x16 trial picture took over 60 s"
    if done.returncode == 0:
        return True, "ok"
    if done.returncode < 0:
        return False, (
            f"VTK ended with signal {-done.returncode}; on Debian or Ubuntu: "
            "apt-get install -y --no-install-recommends libgl1 libegl1"
        )
    return False, (done.stderr.strip().splitlines() or ["unknown error"])[-1]


def prepare() -> None:
    """On Linux without a display, tell VTK to draw through EGL rather than search for an X server."""
    headless = not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
    if sys.platform == "linux" and headless:
        os.environ.setdefault("VTK_DEFAULT_OPENGL_WINDOW", "vtkEGLRenderWindow")
