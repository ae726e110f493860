"""The numbers at the top of a report, in words for somebody who reads them for the first time."""

from dataclasses import dataclass


@dataclass(frozen=True)
class ShownNumber:
    """A metric on the page."""

    label: str
    meaning: str
    """What it says, for somebody who reads it for the first time."""


NUMBERS = {
    "psnr_held_out_db": ShownNumber(
        "PSNR of held-out views",
        "how near the drawn pictures are to photographs that the map has never seen: 20 dB is "
        "blurred, 30 dB is good, 10 dB more is a tenth of the squared error",
    ),
    "ssim_held_out": ShownNumber(
        "SSIM of held-out views", "how alike their structures are: 1 is equal"
    ),
    "depth_l1_held_out_m": ShownNumber(
        "depth error of held-out views",
        "how far the drawn surface is from the measured one, on average",
    ),
    "n_gaussians": ShownNumber(
        "Gaussians",
        "small soft discs of colour that the map is made of; fewer are faster and take less memory",
    ),
    "mesh_accuracy_m": ShownNumber(
        "mesh to true surface", "how far the map's triangles are from the room as it was built"
    ),
    "mesh_completion_ratio": ShownNumber(
        "true surface in the mesh", "share of what was filmed that has triangles within 3 cm"
    ),
    "fps_total": ShownNumber(
        "speed while mapping", "frames that became part of the map in a second"
    ),
    "seconds_online": ShownNumber("mapping", "time for the whole walk"),
    "seconds_global": ShownNumber(
        "passes after the scan", "time to go through the pictures again afterwards"
    ),
    "seconds_compiling": ShownNumber(
        "compiling", "time in which kernels were compiled, once on a machine; no part of the speed"
    ),
    "psnr_mapped_db": ShownNumber(
        "PSNR of mapped views", "the same for photographs that the map was made of"
    ),
    "n_keyframes": ShownNumber("keyframes", "frames that the map is fitted to again and again"),
    "peak_memory_mb": ShownNumber(
        "largest memory", "what the program needed at most; 1000 MB are a gigabyte"
    ),
}
"""Name of a metric -> what it is."""
