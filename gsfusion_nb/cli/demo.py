"""``gsfusion-nb demo``: the built-in room, mapped by two systems."""

from dataclasses import dataclass

from ..backends import backend_names, from_environment, use_backend
from ..config import gps_slam, gsfusion
from ..config.options import named
from .compile_ahead import CompileAhead
from .result import print_result


@dataclass(frozen=True, kw_only=True)
class DemoOptions:
    """Map the built-in room by GSFusion and by GPS-SLAM, and write a report of both, side by
    side."""

    out: str = ""
    """New or empty folder for the results, with a folder of each run; runs/room-<time> by
    default."""
    frames: int = 120
    """Number of frames, spread evenly over one walk through the room. More: a better map, and more
    time."""
    backend: str = named(from_environment, backend_names)
    """What the operations run on; the environment variable GSFUSION_BACKEND changes the default."""


def run(options: DemoOptions) -> int:
    """The command. The exit status is that of the run that did not end, else 0."""
    from ..runs import run_mapping
    from ..runs.run_folder import new_folder
    from ..runs.side_by_side import numbers_of, write_side_by_side
    from ..viz.growing_page import GrowingPage

    runs = []
    systems = {"gsfusion": gsfusion("room"), "gps_slam": gps_slam("room")}
    with use_backend(options.backend), CompileAhead():
        folder = new_folder("room", options.out or None)
        report = folder / "report.html"
        print("Mapping the built-in room; the first run also renders its images and stores them.")
        print(f"Open {report} now: it shows the first pictures, and in the end the report.")
        with GrowingPage(report, "The built-in room") as page:
            for name, config in systems.items():
                mapping = run_mapping(
                    "room", config, folder=folder / name, n_frames=options.frames, watch=page
                )
                if mapping.run.status != "complete":
                    return print_result(mapping)
                runs.append(mapping)
            write_side_by_side(report, runs)
    for cells in numbers_of(runs):
        print(f"{cells[0]:<30}" + "".join(f"{cell:>18}" for cell in cells[1:]))
    print("Both maps, trajectory, numbers and report of each:", *(each.folder for each in runs))
    print(f"Side by side: {report}")
    return 0
