"""A commented example of the file that describes a comparison."""

EXAMPLE = """\
# A comparison of seeding rules: every rule, on every scene, with every seed, at every budget.
#   gsfusion-nb lab THIS_FILE --jobs 2
# The same command again continues after Ctrl-C, and computes nothing twice.

seeds = [0, 1, 2]      # or a number: seeds = 3 is the same
system = "gsfusion"    # or "rtg_slam", "gps_slam"
# preset = "room"      # settings published for a data set; default: room for the room, else replica

[settings]             # of all runs; names as in gsfusion-nb map --help
"data.width" = 160
"data.height" = 120
"tsdf.voxel_size_m" = 0.02
"sh_degree" = 0
"seeding.quadtree_contrast" = "std"
"optim.global_iterations" = 3

[[scenes]]
data = "room"          # the built-in room, or the folder of a recording
label = "room"         # its name in the tables
reader = { n_frames = 60 }

[[scenes]]
data = "room"
label = "room, every other frame"
reader = { n_frames = 60 }
settings = { "data.stride" = 2 }

[[budgets]]            # leave out all budgets for: equal steps, as many Gaussians as each rule makes
gaussians = 2000       # one option of each rule is tuned until its map has this many
tolerance = 0.05       # within 5 per cent
steps = "equal"        # the same gradient steps for every rule; "own": they follow from the rule's seeds
# seconds = 10         # or: equal wall time

[[rules]]
rule = "gsfusion"

[[rules]]
rule = "uniform"

[[rules]]
rule = "rtg_slam"
label = "RTG-SLAM's"
options = { transparent = false }

[[rules]]
rule = "dense"
size_option = "thin"   # the option that is tuned; "thin" keeps a random share of the seeds
label = "dense, thinned"

# [[rules]]
# rule = "my_rules.py:grid"    # a rule from a file beside this one
# size_option = "spacing_px"   # its option that decides how many Gaussians it makes
# size_range = [1, 100]
"""
