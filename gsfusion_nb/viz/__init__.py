"""Pictures, live views and panels for notebooks. Import them from here; each is loaded when it is first used."""

import importlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from ..drawing.curves import curve_figure as curve_figure
    from ..drawing.curves import figure_png as figure_png
    from ..drawing.pictures import colour_depth as colour_depth
    from ..drawing.pictures import error_map as error_map
    from ..drawing.pictures import paint_cells as paint_cells
    from ..drawing.pictures import to_uint8 as to_uint8
    from ..drawing.side_by_side import side_by_side as side_by_side
    from .display import show as show
    from .display import show_figure as show_figure
    from .display import static_views as static_views
    from .live.live_loop import LiveLoop as LiveLoop
    from .live.live_mapper import LiveMapper as LiveMapper
    from .live.orbit import OrbitView as OrbitView
    from .live.orbit import orbit_view as orbit_view
    from .live.player import Player as Player
    from .meshes.show import show_mesh as show_mesh
    from .microscopes.gaussian_panels import one_gaussian_panel as one_gaussian_panel
    from .microscopes.gaussian_panels import sh_ball_panel as sh_ball_panel
    from .microscopes.gradient_microscope import GradientMicroscope as GradientMicroscope
    from .microscopes.mix_microscope import MixMicroscope as MixMicroscope
    from .microscopes.one_gaussian import basis_atlas as basis_atlas
    from .microscopes.one_gaussian import gaussian_row as gaussian_row
    from .microscopes.one_gaussian import orientation_from_angles as orientation_from_angles
    from .microscopes.pixel_microscope import PixelMicroscope as PixelMicroscope
    from .microscopes.pixel_stack import pixel_stack as pixel_stack
    from .microscopes.pixel_stack import project_splats as project_splats
    from .microscopes.stack_picture import ellipse_picture as ellipse_picture
    from .microscopes.stack_picture import resize_to_height as resize_to_height
    from .microscopes.tile_picture import tile_picture as tile_picture
    from .panels.discs import disc_adding_panel as disc_adding_panel
    from .panels.discs import disc_panel as disc_panel
    from .panels.discs import disc_scene as disc_scene
    from .panels.discs import disc_scene_picture as disc_scene_picture
    from .panels.icp import basin_picture as basin_picture
    from .panels.icp import convergence_basin as convergence_basin
    from .panels.icp import displaced_pose as displaced_pose
    from .panels.icp import frame_surface as frame_surface
    from .panels.icp import icp_panel as icp_panel
    from .panels.icp import path_picture as path_picture
    from .panels.icp import pose_error as pose_error
    from .panels.icp import residual_picture as residual_picture
    from .panels.icp import single_level_config as single_level_config
    from .panels.keyframe_strip import keyframe_strip as keyframe_strip
    from .panels.points import normal_colours as normal_colours
    from .panels.points import point_panel as point_panel
    from .panels.quadtree import cell_means as cell_means
    from .panels.quadtree import quadtree_panel as quadtree_panel
    from .panels.quadtree import quadtree_picture as quadtree_picture
    from .panels.repair import repair_panel as repair_panel
    from .panels.seeding_rule import rule_context as rule_context
    from .panels.seeding_rule import rule_panel as rule_panel
    from .panels.seeding_rule import rule_picture as rule_picture
    from .panels.stage_bars import amdahl_panel as amdahl_panel
    from .panels.stage_bars import sped_up as sped_up
    from .panels.stage_bars import stage_bars as stage_bars
    from .panels.stage_bars import stage_means as stage_means
    from .panels.surface import surface_panel as surface_panel
    from .panels.trace import TracePanel as TracePanel
    from .panels.tsdf_fill import tsdf_fill_panel as tsdf_fill_panel
    from .panels.tsdf_slice import distance_colours as distance_colours
    from .panels.tsdf_slice import slice_picture as slice_picture
    from .splats.map_picture import draw_gaussians as draw_gaussians
    from .splats.viewer import SplatViewer as SplatViewer
    from .steppers.adam import adam_stepper as adam_stepper
    from .steppers.compositing import compositing_stepper as compositing_stepper
    from .steppers.compositing_gradient import compositing_gradient_stepper as compositing_gradient_stepper
    from .steppers.icp import icp_stepper as icp_stepper
    from .steppers.marching_cubes import marching_cubes_stepper as marching_cubes_stepper
    from .steppers.pose_graph import pose_graph_stepper as pose_graph_stepper
    from .steppers.quadtree import quadtree_stepper as quadtree_stepper
    from .steppers.raycast import raycast_stepper as raycast_stepper
    from .steppers.stepper import Stepper as Stepper
    from .summaries import html_summary as html_summary
    from .viewpoint import orbit_camera as orbit_camera

_LAZY = {
    "GradientMicroscope": ".microscopes.gradient_microscope",
    "LiveMapper": ".live.live_mapper",
    "OrbitView": ".live.orbit",
    "Stepper": ".steppers.stepper",
    "MixMicroscope": ".microscopes.mix_microscope",
    "PixelMicroscope": ".microscopes.pixel_microscope",
    "Player": ".live.player",
    "TracePanel": ".panels.trace",
    "surface_panel": ".panels.surface",
    "SplatViewer": ".splats.viewer",
    "LiveLoop": ".live.live_loop",
    "disc_adding_panel": ".panels.discs",
    "amdahl_panel": ".panels.stage_bars",
    "convergence_basin": ".panels.icp",
    "basin_picture": ".panels.icp",
    "basis_atlas": ".microscopes.one_gaussian",
    "html_summary": ".summaries",
    "cell_means": ".panels.quadtree",
    "colour_depth": "..drawing.pictures",
    "curve_figure": "..drawing.curves",
    "disc_panel": ".panels.discs",
    "disc_scene": ".panels.discs",
    "distance_colours": ".panels.tsdf_slice",
    "draw_gaussians": ".splats.map_picture",
    "ellipse_picture": ".microscopes.stack_picture",
    "resize_to_height": ".microscopes.stack_picture",
    "error_map": "..drawing.pictures",
    "sped_up": ".panels.stage_bars",
    "figure_png": "..drawing.curves",
    "tsdf_fill_panel": ".panels.tsdf_fill",
    "frame_surface": ".panels.icp",
    "gaussian_row": ".microscopes.one_gaussian",
    "icp_panel": ".panels.icp",
    "keyframe_strip": ".panels.keyframe_strip",
    "displaced_pose": ".panels.icp",
    "normal_colours": ".panels.points",
    "one_gaussian_panel": ".microscopes.gaussian_panels",
    "orbit_camera": ".viewpoint",
    "orbit_view": ".live.orbit",
    "paint_cells": "..drawing.pictures",
    "path_picture": ".panels.icp",
    "pixel_stack": ".microscopes.pixel_stack",
    "point_panel": ".panels.points",
    "pose_error": ".panels.icp",
    "project_splats": ".microscopes.pixel_stack",
    "quadtree_panel": ".panels.quadtree",
    "quadtree_picture": ".panels.quadtree",
    "repair_panel": ".panels.repair",
    "residual_picture": ".panels.icp",
    "rule_context": ".panels.seeding_rule",
    "rule_panel": ".panels.seeding_rule",
    "rule_picture": ".panels.seeding_rule",
    "sh_ball_panel": ".microscopes.gaussian_panels",
    "show": ".display",
    "show_figure": ".display",
    "show_mesh": ".meshes.show",
    "side_by_side": "..drawing.side_by_side",
    "single_level_config": ".panels.icp",
    "slice_picture": ".panels.tsdf_slice",
    "stage_bars": ".panels.stage_bars",
    "stage_means": ".panels.stage_bars",
    "disc_scene_picture": ".panels.discs",
    "static_views": ".display",
    "adam_stepper": ".steppers.adam",
    "compositing_gradient_stepper": ".steppers.compositing_gradient",
    "compositing_stepper": ".steppers.compositing",
    "icp_stepper": ".steppers.icp",
    "marching_cubes_stepper": ".steppers.marching_cubes",
    "pose_graph_stepper": ".steppers.pose_graph",
    "quadtree_stepper": ".steppers.quadtree",
    "raycast_stepper": ".steppers.raycast",
    "tile_picture": ".microscopes.tile_picture",
    "to_uint8": "..drawing.pictures",
    "orientation_from_angles": ".microscopes.one_gaussian",
}


def __getattr__(name: str):
    if name in _LAZY:
        return getattr(importlib.import_module(_LAZY[name], __name__), name)
    raise AttributeError(f"module 'gsfusion_nb.viz' has no attribute {name!r}")


def __dir__():
    return sorted([*globals(), *_LAZY])
