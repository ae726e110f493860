"""What runs a submission: a process without the solutions, with limits, that is called over a socket.

The modules here are copied into an installation from which the solutions are left out (``grading/isolated.py``), so
they import nothing else of ``gsfusion_nb.course``.
"""
