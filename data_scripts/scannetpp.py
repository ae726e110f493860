"""Prepare scenes of ScanNet++ (Yeshwanth et al. 2023) from your own licensed copy. Nothing is downloaded.

    python data_scripts/scannetpp.py /data/scannetpp/data/8b5caf3398 --out data

Photographs are undistorted at half resolution and depth is rendered from the scan's mesh, without a graphics card or
display; that takes about 3 s a picture.
"""

import sys
from pathlib import Path

from gsfusion_nb.export import read_mesh_ply
from gsfusion_nb.recordings import fetch
from gsfusion_nb.recordings.convert.scannetpp_scene import MESH, listed_pictures, prepare_scene
from gsfusion_nb.recordings.fetch import FetchError, Plan, SequenceOnDisk

BYTES_PER_PICTURE = 800_000


def plan(name: str) -> Plan:
    """One scene of the copy."""
    scene = Path(name).expanduser().resolve()
    if not (scene / MESH).is_file():
        raise FetchError(f"{scene / MESH} does not exist; expected the folder of a ScanNet++ scene with its scan")
    n_pictures = len(listed_pictures(scene))
    return Plan(
        folder=f"scannetpp/{scene.name}",
        title=f"ScanNet++, {scene}: {n_pictures} photographs at half resolution, depth from the laser scan",
        licence="ScanNet++ Terms of Use: NON-COMMERCIAL research, no redistribution, also of the result.",
        cite="Yeshwanth, Liu, Niessner, Dai: ScanNet++: A High-Fidelity Dataset of 3D Indoor Scenes, 2023.",
        unpacked_bytes=n_pictures * BYTES_PER_PICTURE,
        sequences=lambda root: [SequenceOnDisk(preset="scannetpp")],
        convert=lambda folder: prepare_scene(scene, read_mesh_ply(scene / MESH), folder),
    )


def main(arguments: list[str] | None = None) -> int:
    """Prepare the scenes named on the command line."""
    return fetch.run(__doc__ or "", plan, arguments=arguments)


if __name__ == "__main__":
    sys.exit(main())
