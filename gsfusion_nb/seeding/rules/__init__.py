"""One file per rule; importing a file registers its rule."""

from .cg_slam import cg_slam as cg_slam
from .default_strategy import default_strategy as default_strategy
from .dense import dense as dense
from .edge_discs import edge_discs as edge_discs
from .edge_strokes import edge_strokes as edge_strokes
from .gaus_slam import gaus_slam as gaus_slam
from .gaussian_slam import gaussian_slam as gaussian_slam
from .gps_slam import gps_slam as gps_slam
from .gs_icp import gs_icp as gs_icp
from .gs_slam import gs_slam as gs_slam
from .gsfusion import gsfusion as gsfusion
from .hf_slam import hf_slam as hf_slam
from .mcmc import mcmc as mcmc
from .mm3dgs import mm3dgs as mm3dgs
from .monogs import monogs as monogs
from .monogs_like import monogs_like as monogs_like
from .on_the_fly_nvs import on_the_fly_nvs as on_the_fly_nvs
from .photo_slam import photo_slam as photo_slam
from .rtg_slam import rtg_slam as rtg_slam
from .splatam import splatam as splatam
from .splatam_like import splatam_like as splatam_like
from .two_dgs_slam import two_dgs_slam as two_dgs_slam
from .uniform import uniform as uniform
from .vings import vings as vings
from .vtgaussian import vtgaussian as vtgaussian
