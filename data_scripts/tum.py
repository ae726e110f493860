"""Fetch sequences of the TUM RGB-D benchmark (Sturm et al. 2012): a hand-held Kinect, poses from
motion capture.

python data_scripts/tum.py fr1_desk --out data
"""

import sys

from gsfusion_nb.recordings import fetch
from gsfusion_nb.recordings.fetch import Item, Plan, SequenceOnDisk

HOST = "https://cvg.cit.tum.de/rgbd/dataset"
SIZES_GB = {
    "fr1_xyz": 0.47,
    "fr1_rpy": 0.42,
    "fr1_360": 0.45,
    "fr1_floor": 0.6,
    "fr1_desk": 0.4,
    "fr1_desk2": 0.4,
    "fr1_room": 0.83,
    "fr1_plant": 0.7,
    "fr1_teddy": 1.0,
    "fr2_xyz": 2.4,
    "fr2_rpy": 2.1,
    "fr2_desk": 2.0,
    "fr3_office": 1.6,
}
"""Sequences and their approximate sizes: the benchmark publishes no exact sizes and no
checksums."""


def plan(name: str) -> Plan:
    """Files of one sequence."""
    camera, _, short = name.partition("_")
    camera = camera.replace("fr", "freiburg")
    folder = f"rgbd_dataset_{camera}_{'long_office_household' if short == 'office' else short}"
    size = int(SIZES_GB[name] * 1e9)

    def choose(path: str) -> str | None:
        return path.removeprefix(f"{folder}/") if path.startswith(f"{folder}/") else None

    return Plan(
        folder=f"tum/{folder}",
        title=f"TUM RGB-D benchmark, {name}",
        licence="Creative Commons Attribution 4.0 (CC BY 4.0).",
        cite="Sturm, Engelhard, Endres, Burgard, Cremers: A Benchmark for the Evaluation of RGB-D "
        "SLAM Systems, 2012.",
        items=[Item(url=f"{HOST}/{camera}/{folder}.tgz", stated_bytes=size, choose=choose)],
        unpacked_bytes=size,
        sequences=lambda root: [SequenceOnDisk(preset="tum")],
    )


def main(arguments: list[str] | None = None) -> int:
    """Fetch what the command line names."""
    return fetch.run(__doc__ or "", plan, sorted(SIZES_GB), arguments)


if __name__ == "__main__":
    sys.exit(main())
