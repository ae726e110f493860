"""Prepare scenes of ScanNet++ (Yeshwanth et al. 2023) from your own licensed copy. Nothing is downloaded.

    python data_scripts/scannetpp.py /data/scannetpp/data/8b5caf3398 --out data

Photographs are undistorted at half resolution and depth is rendered from the scan's mesh, without a graphics card or
display. An interrupted run continues with the next picture.
"""

import sys
from pathlib import Path

from gsfusion_nb.data.convert.scannetpp_scene import MESH, listed_pictures, prepare_scene
from gsfusion_nb.data.fetch import FetchError, SequenceOnDisk, command
from gsfusion_nb.data.fetch.disk import require_space, size_text
from gsfusion_nb.data.fetch.plan import agree, duration_text
from gsfusion_nb.data.fetch.work_folder import only_one, unfinished_folder
from gsfusion_nb.export import read_mesh_ply

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


def prepare(scene: Path, fetch_options: command.FetchOptions) -> None:
    """Prepare one scene."""
    scene = scene.expanduser().resolve()
    target = fetch_options.out / "scannetpp" / scene.name
    if not target.exists():
        if not (scene / MESH).is_file():
            raise FetchError(f"{scene / MESH} does not exist; expected the folder of a ScanNet++ scene with its scan")
        names = listed_pictures(scene)
        fetch_options.say(describe(scene, target, len(names)))
        require_space(fetch_options.out, len(names) * BYTES_PER_PICTURE, scene.name)
        agree(yes=fetch_options.yes, ask=fetch_options.ask)
        with only_one(fetch_options.out), unfinished_folder(target, fetch_options.out, resume=True) as folder:
            with command.counting("picture") as progress:
                prepare_scene(scene, read_mesh_ply(scene / MESH), folder, progress=progress)
            SEQUENCE.prove(folder)
    fetch_options.say(f"{SEQUENCE.prove(target)}\n  {SEQUENCE.command(target)}")


def main(arguments: list[str] | None = None) -> int:
    """Prepare the scenes named on the command line."""
    parser = command.parser(__doc__ or "", downloads=False)
    parser.add_argument("scene", nargs="+", type=Path, help="folders of scenes in your copy")
    options = parser.parse_args(arguments)

    def work() -> None:
        for scene in options.scene:
            prepare(scene, command.fetch_options(options))

    return command.run(Path(__file__).name, work)


if __name__ == "__main__":
    sys.exit(main())
