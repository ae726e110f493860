"""The Gaussian renderer: project, tile lists, composite; every stage beside its explicit gradient."""

from .composite import CompositeGradient as CompositeGradient
from .composite import CompositeOutput as CompositeOutput
from .composite import composite as composite
from .composite import composite_vjp as composite_vjp
from .disc import DiscDepth as DiscDepth
from .disc import disc_depth as disc_depth
from .disc import disc_depth_vjp as disc_depth_vjp
from .footprints import Footprints as Footprints
from .footprints import footprints as footprints
from .in_view import rows_in_view as rows_in_view
from .project import Projection as Projection
from .project import ProjectionGradient as ProjectionGradient
from .project import project_gaussians as project_gaussians
from .project import project_gaussians_vjp as project_gaussians_vjp
from .rasterize import Render as Render
from .rasterize import render as render
from .rasterize import render_autograd as render_autograd
from .rasterize import render_forward as render_forward
from .rasterize import render_vjp as render_vjp
from .surface import SurfaceView as SurfaceView
from .surface import blended_depth_m as blended_depth_m
from .surface import surface_depth_m as surface_depth_m
from .surface import view_surface as view_surface
from .tiles import TileLists as TileLists
from .tiles import tile_intersections as tile_intersections
