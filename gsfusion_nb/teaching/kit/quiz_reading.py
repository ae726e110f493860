"""What a reader of the questions knows about single wrong answers, and no checker says.

The names are those of the questions: exercise and number of the wrong answer.
"""

NOT_OFFERED: dict[str, tuple[str, ...]] = {
    "psnr-1": ("the differences are squared before they are averaged",),
    "psnr-3": ("it is a mean over all values, not a sum",),
    "project_points-4": ("a point twice as far lands half as far from the principal point",),
    "tiles_touched-3": ("a splat inside one tile is in that tile", "a splat across a border is on both sides"),
    "composite_pixel-1": ("what is behind gets only the light that is left",),
    "composite_pixel-2": ("what is behind gets only the light that is left", "nothing is in front of the first one"),
    "splat_alpha-2": ("alpha = opacity exp(-sigma)",),
    "project_gaussian-1": ("straight ahead is the principal point",),
    "splat_alpha_vjp-3": ("v_uv = alpha v_alpha (A dx + B dy, B dx + C dy)", "v_opacity = v_alpha exp(-sigma)"),
    "splat_alpha_vjp-4": (
        "v_uv agrees with autograd", "v_conic agrees with autograd", "v_opacity agrees with autograd",
        "v_opacity = v_alpha exp(-sigma)", "v_uv = alpha v_alpha (A dx + B dy, B dx + C dy)",
    ),
    "map_frame-1": ("the new Gaussians are in the map when the frame is optimised",),
    "disc_hit-4": ("beyond 60 degrees the depth of the centre is used",),
    "fuse-1": ("a Gaussian never seen does not change",),
    "fuse-2": ("a Gaussian never seen does not change",),
    "silhouette_rule-3": ("where the map is opaque already, nothing is seeded",),
    "pose_shift-2": ("shifts of up to reach frames are tried",),
    "tell_apart-1": (
        "what counts as small is a multiple of noise_m, for the given pose and for the best one",
        "the best motion may also turn",
    ),
}  # fmt: skip
"""Properties that hold on the inputs of the checker and are not true of the function, or so near the right option that
both could be meant."""

ALSO_TRUE: dict[str, tuple[str, ...]] = {
    "exam_frames-3": ("it names no frame twice", "a frame that it names is one of the n frames"),
    "first_seen-1": (
        "a cell without depth gets no Gaussian", "a voxel that was seen before gets no Gaussian",
        "the two conditions must both hold",
    ),
    "psnr-1": ("a picture that is twice as far off everywhere has a lower PSNR",),
    "block_of-2": (
        "the point (0, 0, 0) is in block (0, 0, 0)", "a block has 8 voxels along each axis", "it returns whole numbers",
    ),
    "slope-1": (
        "it calls the loss once more than x has elements", "a smaller h gives a smaller error, until rounding counts",
    ),
    "fuse-1": (
        "where before and after are equal, it returns them", "every row has its own weight",
        "the weights of before and after add up to 1",
    ),
    "fuse-2": (
        "where before and after are equal, it returns them", "it does not use the numbers of steps",
        "the weights of before and after add up to 1",
    ),
    "disc_hit-4": ("the length of the ray does not matter", "a normal may point either way"),
    "silhouette_rule-3": (
        "a cell without depth gets no Gaussian", "it compares the opacity that it reads with max_alpha",
    ),
    "morton_code-1": ("the code of (0, 0, 0) is 0", "two different blocks have different codes"),
    "zero_crossing-3": ("where D0 = 0 it returns p0", "where D1 = 0 it returns p1", "it returns a point for each edge"),
    "split_cell-2": ("it returns four parts", "the four parts have the right sizes"),
    "covariance_2d-2": (
        "fx acts on u and fy on v", "a Gaussian of twice the size gives a matrix four times as large",
        "off the axis, extent along z widens the ellipse",
    ),
    "slope-3": (
        "it calls the loss twice for each element", "the slope of a straight line is its coefficients",
        "it divides by the distance between the two points at which it calls the loss",
    ),
    "splat_alpha_vjp-3": ("for a single pixel it is right",),
    "splat_alpha_vjp-4": ("where alpha is neither capped nor cut, it is right",),
    "map_frame-1": ("it returns the number of new Gaussians", "no frame becomes a keyframe"),
    "raster_rule-1": (
        "all seeds of the right rule are among its seeds", "it makes one seed more than the right rule",
        "one of its seeds is at the origin of the world",
    ),
    "raster_rule-4": (
        "without an option it takes squares of 8 pixels", "its seeds are where those of the right rule are",
        "it makes as many seeds as the right rule",
    ),
    "adam_traffic-2": (
        "it counts four arrays that are read and three that are written", "the intensity does not depend on the size",
        "twice the numbers give twice the first result",
    ),
    "average_loop-2": (
        "the weight stops at max_weight", "d counts as at most 1", "a voxel without depth does not change",
    ),
}  # fmt: skip
"""Statements that are true of the function as it stands in the question."""

NUMBERED = frozenset({
    "halve_intrinsics-1", "halve_intrinsics-2", "block_of-3", "view_colour-1", "slope-2", "inverse_vjp-1",
    "inverse_vjp-2", "pinhole_vjp-1", "raster_rule-2", "silhouette_rule-1", "attainable_gflops-2",
    "attainable_gflops-3", "adam_traffic-1", "depth_factor-1",
})  # fmt: skip
"""Questions that ask for the number which comes back: the words for the input say all that is needed to find it."""

COUNTED = {"raster_rule": "seeds", "silhouette_rule": "seeds"}
"""Exercises whose judge counts what comes back."""
