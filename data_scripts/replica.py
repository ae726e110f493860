"""Fetch scenes of Replica as rendered for NICE-SLAM (Sucar et al. 2021, Zhu et al. 2022), with
their meshes.

    python data_scripts/replica.py office0 room0 --out data

All eight come in one archive of 12 GB: name all scenes that you need, or use --keep-archives.
Each scene gets mesh.ply, the complete mesh, and mesh_culled.ply, the part that the cameras see, for
scores of geometry.
"""

import re
import sys

from gsfusion_nb.recordings import fetch
from gsfusion_nb.recordings.fetch import Item, Plan, SequenceOnDisk

HOST = "https://cvg-data.inf.ethz.ch/nice-slam"
SCENES = ("office0", "office1", "office2", "office3", "office4", "room0", "room1", "room2")
ARCHIVE_BYTES = 12_400_000_000
SCENE_BYTES = 1_700_000_000
MESHES_BYTES = 300_000_000


def plan(scene: str) -> Plan:
    """Files of one scene."""

    def frames(path: str) -> str | None:
        name = path.removeprefix("Replica/")
        if name == "cam_params.json":
            return name
        if name == f"{scene}_mesh.ply":
            return "mesh.ply"
        return name.removeprefix(f"{scene}/") if name.startswith(f"{scene}/") else None

    def visible(path: str) -> str | None:
        return "mesh_culled.ply" if re.fullmatch(rf"(.*/)?{scene}(_[a-z_]+)?\.ply", path) else None

    return Plan(
        folder=f"replica/{scene}",
        title=f"Replica as rendered for NICE-SLAM, {scene}: 2000 frames of 1200x680, exact depth "
        "and poses",
        licence="Replica's research licence (Meta): NON-COMMERCIAL research only; the renderings "
        "come from ETH Zurich.",
        cite="Straub et al.: The Replica Dataset, 2019; Zhu et al.: NICE-SLAM, 2022.",
        items=[
            Item(url=f"{HOST}/data/Replica.zip", stated_bytes=ARCHIVE_BYTES, choose=frames),
            Item(url=f"{HOST}/cull_replica_mesh.zip", stated_bytes=MESHES_BYTES, choose=visible),
        ],
        unpacked_bytes=SCENE_BYTES,
        sequences=lambda root: [SequenceOnDisk(preset="replica")],
        note="all scenes come in one archive: name all that you need, or use --keep-archives",
    )


def main(arguments: list[str] | None = None) -> int:
    """Fetch what the command line names."""
    return fetch.run(__doc__ or "", plan, SCENES, arguments)


if __name__ == "__main__":
    sys.exit(main())
