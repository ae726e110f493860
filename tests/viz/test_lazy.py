"""Importing the room of pictures must not load the heavy packages."""

import subprocess
import sys


def test_viz_is_light_and_complete():
    code = (
        "import sys, gsfusion_nb.viz as v; "
        "heavy = [m for m in ('ipywidgets', 'pyvista', 'matplotlib', 'cv2', 'IPython') if m in sys.modules]; "
        "from gsfusion_nb.viz import LiveMapper, Player, SplatViewer, map_picture, orbit_camera, show, show_mesh; "
        "late = [m for m in ('pyvista', 'matplotlib') if m in sys.modules]; "
        "missing = [n for n in v.__all__ if not callable(getattr(v, n))]; "
        "print(heavy, late, missing)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[] [] []"
