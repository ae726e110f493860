"""Scores of a map: images, geometry and trajectory."""

from .discs import disc_scores as disc_scores
from .discs import sample_discs as sample_discs
from .geometry import GeometryScores as GeometryScores
from .geometry import cull_unseen as cull_unseen
from .geometry import mesh_scores as mesh_scores
from .geometry import sample_surface as sample_surface
from .geometry import seen_by as seen_by
from .image import ImageScores as ImageScores
from .image import ViewScores as ViewScores
from .image import depth_l1_m as depth_l1_m
from .image import expected_depth_m as expected_depth_m
from .image import lpips as lpips
from .image import psnr as psnr
from .image import score_view as score_view
from .image import score_views as score_views
from .image import ssim as ssim
from .mesh_colour import mesh_psnr as mesh_psnr
from .metrics import ONLINE as ONLINE
from .metrics import format_metric as format_metric
from .metrics import frame_rates as frame_rates
from .metrics import metrics_as_json as metrics_as_json
from .not_computed import NotComputed as NotComputed
from .trajectory import align_umeyama as align_umeyama
from .trajectory import ate_rmse as ate_rmse
from .trajectory import rpe as rpe
from .trajectory import trajectory_scores as trajectory_scores
