"""The values that travel between the rooms: camera, frame, seeds, render output. Frozen; inputs are
never modified."""

from .camera import Camera as Camera
from .frame import Extras as Extras
from .frame import Frame as Frame
from .frame import rgb_of_bytes as rgb_of_bytes
from .gaussian_rows import ALL_ROWS as ALL_ROWS
from .gaussian_rows import GaussianParams as GaussianParams
from .gaussian_rows import MapRows as MapRows
from .gaussian_rows import Seeds as Seeds
from .mesh import Mesh as Mesh
from .render_output import RenderOutput as RenderOutput
