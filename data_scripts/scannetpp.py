"""Prepare scenes of ScanNet++ (Yeshwanth et al. 2023) from your own licensed copy. Nothing is downloaded.

    python data_scripts/scannetpp.py /data/scannetpp/data/8b5caf3398 --out data

Photographs are undistorted at half resolution and depth is rendered from the scan's mesh, without a graphics card or
display.
"""

import sys
from pathlib import Path

from gsfusion_nb.export import read_mesh_ply
from gsfusion_nb.recordings import fetch
from gsfusion_nb.recordings.convert.scannetpp_scene import MESH, listed_pictures, prepare_scene
from gsfusion_nb.recordings.fetch import FetchError, FetchOptions, SequenceOnDisk, duration_text, size_text

BYTES_PER_PICTURE = 800_000
SECONDS_PER_PICTURE = 3.0
SEQUENCE = SequenceOnDisk(preset="scannetpp")


def describe(scene: Path, target: Path, n_pictures: int) -> str:
    """Description of the result and its licence."""
    size, seconds = size_text(n_pictures * BYTES_PER_PICTURE), duration_text(n_pictures * SECONDS_PER_PICTURE)
    return (
        f"ScanNet++, {scene.name}: {n_pictures} photographs at half resolution, depth from the laser scan\n"
        f"  from     {scene} (your copy)\n  to       {target} (about {size})\n  time     about {seconds}\n"
        "  licence  ScanNet++ Terms of Use: NON-COMMERCIAL research, no redistribution, also of the result.\n"
        "  cite     Yeshwanth, Liu, Niessner, Dai: ScanNet++: A High-Fidelity Dataset of 3D Indoor Scenes, 2023."
    )


def prepare(scene: Path, options: FetchOptions) -> None:
    """Prepare one scene."""
    scene = scene.expanduser().resolve()
    target = options.out / "scannetpp" / scene.name
    if not target.exists():
        if not (scene / MESH).is_file():
            raise FetchError(f"{scene / MESH} does not exist; expected the folder of a ScanNet++ scene with its scan")
        names = listed_pictures(scene)
        fetch.say(describe(scene, target, len(names)))
        fetch.require_space(options.out, len(names) * BYTES_PER_PICTURE, scene.name)
        fetch.agree(options)
        with fetch.new_folder(target, options.out) as folder:
            with fetch.counting("picture") as progress:
                prepare_scene(scene, read_mesh_ply(scene / MESH), folder, progress=progress)
            SEQUENCE.prove(folder)
    fetch.say(f"{SEQUENCE.prove(target)}\n  {SEQUENCE.command(target)}")


def main(arguments: list[str] | None = None) -> int:
    """Prepare the scenes named on the command line."""
    parser = fetch.parser(__doc__ or "", downloads=False)
    parser.add_argument("scene", nargs="+", type=Path, help="folders of scenes in your copy")
    options = parser.parse_args(arguments)

    def work() -> None:
        for scene in options.scene:
            prepare(scene, fetch.fetch_options(options))

    return fetch.run(Path(__file__).name, work)


if __name__ == "__main__":
    sys.exit(main())
