"""The Gaussian map, its rows and their states."""

from .apply_edit import SPLIT_SHRINKS as SPLIT_SHRINKS
from .apply_edit import shared as shared
from .edit import Edit as Edit
from .history import fuse_with_history as fuse_with_history
from .model import PLY_BYTES as PLY_BYTES
from .model import GaussianModel as GaussianModel
from .moments import restart_optimiser as restart_optimiser
from .step_clock import StepClock as StepClock
from .surfel_states import Transitions as Transitions
from .surfel_states import change_states as change_states
from .surfel_states import count_errors as count_errors
from .surfel_states import count_views as count_views
from .surfel_states import state_counts as state_counts
from .surfels import OPAQUE as OPAQUE
from .surfels import STABLE as STABLE
from .surfels import TRANSPARENT as TRANSPARENT
from .surfels import UNSTABLE as UNSTABLE
from .surfels import SurfelModel as SurfelModel
from .surfels import radius_of as radius_of
