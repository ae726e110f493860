"""Write the built-in room to disk as a sample of each layout. Nothing is downloaded.

    python data_scripts/room.py tum --out data
    python data_scripts/room.py all --frames 60

The images of folder, replica and scannetpp have the size --width x --height; those of tum and seven_scenes have
640x480, the size of their camera.
"""

import sys
from pathlib import Path

from gsfusion_nb.data.room import room_mesh
from gsfusion_nb.export import write_mesh_ply
from gsfusion_nb.recordings import fetch
from gsfusion_nb.recordings.fetch import FetchOptions, duration_text, size_text
from gsfusion_nb.recordings.room_layouts import WRITERS, Walk

BYTES_PER_FRAME, BYTES_OF_MESH = 500_000, 9_000_000
SECONDS_PER_FRAME, SECONDS_OF_MESH = 0.25, 10.0


def write(layout: str, walk: Walk, options: FetchOptions) -> None:
    """Write one layout."""
    name, writer = WRITERS[layout]
    target = options.out / name
    size = BYTES_OF_MESH + walk.n_frames * BYTES_PER_FRAME
    seconds = SECONDS_OF_MESH + walk.n_frames * SECONDS_PER_FRAME
    fetch.say(
        f"The built-in room in the layout {layout}: {walk.n_frames} frames\n"
        f"  to       {target} (about {size_text(size)})\n"
        f"  time     about {duration_text(seconds)}\n  licence  Apache-2.0, as the package"
    )
    fetch.require_space(options.out, size, name)
    with fetch.new_folder(target, options.out) as folder:
        with fetch.counting("frame") as progress:
            sequence = writer(folder, walk, progress)
        write_mesh_ply(folder / "mesh.ply", room_mesh(0.03, seed=walk.seed))
        proof = sequence.prove(folder)
    fetch.say(f"{proof}\n  {sequence.command(target)}")


def main(arguments: list[str] | None = None) -> int:
    """Write the layouts named on the command line."""
    parser = fetch.parser(__doc__ or "", downloads=False)
    parser.add_argument("layout", nargs="+", choices=(*WRITERS, "all"), help="which layouts")
    parser.add_argument("--frames", type=int, default=200, help="frames of the walk (default: 200)")
    parser.add_argument("--width", type=int, default=640, help="width of the images, pixels (default: 640)")
    parser.add_argument("--height", type=int, default=480, help="height of the images, pixels (default: 480)")
    options = parser.parse_args(arguments)

    def work() -> None:
        walk = Walk(n_frames=options.frames, width=options.width, height=options.height)
        for layout in WRITERS if "all" in options.layout else dict.fromkeys(options.layout):
            write(layout, walk, fetch.fetch_options(options))

    return fetch.run(Path(__file__).name, work)


if __name__ == "__main__":
    sys.exit(main())
