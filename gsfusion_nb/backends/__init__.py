"""Which implementation of an operation runs: the plain reference, or a faster one.

An operation is declared once, by putting ``@op("folder")`` on its reference. Faster versions are
functions of the same name in ``kernels/<folder>/<backend>.py``; they are found by their file name
and imported on first use. Nothing else in the package imports ``gsfusion_nb.kernels``.

``numba`` (CPU), ``triton`` and ``cuda`` (NVIDIA GPUs) are compiled, for float32. Operations on
Gaussians in float64, and on tensors on other devices, run on the reference instead.

``mine`` is the reference with the functions of a learner in it (``FUNCTIONS``). They replace whole
operations, or the parts of an operation that are declared with ``@piece``. It exists only in a
Python session that has imported ``gsfusion_nb.course.learner_backend``.

An observer sees the calls of marked functions (``observed``, ``observing``). Nothing is watched by
default; a marked function then costs one look at a variable.
"""

from .choice import backend_names as backend_names
from .choice import chosen as chosen
from .choice import from_environment as from_environment
from .choice import runs_learners_code as runs_learners_code
from .choice import use_backend as use_backend
from .dispatch import Record as Record
from .dispatch import op as op
from .dispatch import piece as piece
from .learner import CALLS as CALLS
from .learner import FUNCTIONS as FUNCTIONS
from .learner import MINE as MINE
from .learner import Calls as Calls
from .observers import observed as observed
from .observers import observing as observing
from .offers import BACKENDS as BACKENDS
from .offers import BackendUnavailable as BackendUnavailable
from .offers import automatic as automatic
from .offers import is_compiled as is_compiled
from .offers import kernel_threads as kernel_threads
from .offers import load as load
from .offers import look_again as look_again
from .offers import offered as offered
from .offers import operations as operations
from .offers import report as report
from .registry import reference_of as reference_of
