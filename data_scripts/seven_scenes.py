"""Fetch scenes of Microsoft's 7-Scenes (Shotton et al. 2013): a hand-held Kinect, poses from
KinectFusion.

    python data_scripts/seven_scenes.py heads --out data

As published, colour is not registered to depth (10 to 20 pixels off). The printed command has
--reader register=true, which warps depth into the colour camera with a calibration estimated on
RedKitchen.
"""

import re
import sys
from pathlib import Path

from gsfusion_nb.recordings import fetch
from gsfusion_nb.recordings.fetch import Item, Plan, SequenceOnDisk
from gsfusion_nb.recordings.unpack import ArchiveError

HOST = "https://download.microsoft.com/download/2/8/5/28564B23-0828-408F-8631-23B1EFF1DAC8"
FRAMES = {
    "chess": 6000,
    "fire": 4000,
    "heads": 2000,
    "office": 10_000,
    "pumpkin": 6000,
    "redkitchen": 12_000,
    "stairs": 3000,
}
"""Scenes, and the number of frames in all their sequences."""
BYTES_PER_FRAME = 550_000
"""Estimated."""


def unpack_sequences(folder: Path) -> None:
    """Each sequence is an archive inside the scene's archive."""
    for archive in sorted(folder.glob("seq-*.zip")):
        inner = f"{archive.stem}/"

        def choose(path: str, inner: str = inner) -> str | None:
            name = path.removeprefix(inner)
            return (
                inner + name
                if re.fullmatch(r"frame-\d+\.(color\.(png|jpg)|depth\.png|pose\.txt)", name)
                else None
            )

        fetch.unpack(archive, folder, choose=choose)
        archive.unlink()
    if not sequences(folder):
        raise ArchiveError(
            f"{folder.name}: the archive holds no seq-01.zip or similar; expected the scene's "
            "sequences"
        )


def sequences(folder: Path) -> list[SequenceOnDisk]:
    """One per sequence."""
    names = sorted(path.name for path in folder.glob("seq-*") if path.is_dir())
    return [
        SequenceOnDisk(
            path=name,
            preset="tum",
            reader={"register": True},
        )
        for name in names
    ]


def plan(scene: str) -> Plan:
    """Files of one scene."""
    size = FRAMES[scene] * BYTES_PER_FRAME

    def choose(path: str) -> str | None:
        name = path.removeprefix(f"{scene}/")
        return name if re.fullmatch(r"seq-\d+\.zip|(Train|Test)Split\.txt", name) else None

    return Plan(
        folder=f"7scenes/{scene}",
        title=f"7-Scenes, {scene}: {FRAMES[scene]} frames",
        licence="Microsoft Research licence (MSR-LA): NON-COMMERCIAL use only.",
        cite="Shotton et al.: Scene Coordinate Regression Forests for Camera Relocalization in "
        "RGB-D Images, 2013.",
        items=[Item(url=f"{HOST}/{scene}.zip", stated_bytes=size, choose=choose)],
        unpacked_bytes=2 * size,  # temporarily both the inner archives and their content
        sequences=sequences,
        convert=unpack_sequences,
        note="colour is registered to depth by the reader (register=true), with a calibration "
        "estimated on RedKitchen",
    )


def main(arguments: list[str] | None = None) -> int:
    """Fetch what the command line names."""
    return fetch.run(__doc__ or "", plan, sorted(FRAMES), arguments)


if __name__ == "__main__":
    sys.exit(main())
