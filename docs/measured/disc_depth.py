"""Fig. 7 of RTG-SLAM: ``python docs/measured/disc_depth.py [FOLDER] [VIEWS]``, by default 20 views
of the room."""

import dataclasses
import statistics
import sys

from gsfusion_nb.config import rtg_slam
from gsfusion_nb.data import open_sequence
from gsfusion_nb.mapping.fit_image import fit_image

data = sys.argv[1] if len(sys.argv) > 1 else "room"
views = int(sys.argv[2]) if len(sys.argv) > 2 else 20
sequence = open_sequence(data, data=dataclasses.replace(rtg_slam("room").data, hold_out_every=0))
frames = [sequence[round(i * (len(sequence) - 1) / max(views - 1, 1))] for i in range(views)]
for n in (500, 1000, 2000, 4000, 8000):
    for method in ("disc", "blended", "round"):
        rows = [fit_image(frame, n, method) for frame in frames]
        means = (f"{name} {statistics.fmean(row[name] for row in rows):.2f}" for name in rows[0])
        print(f"{n:,} {method}: {'; '.join(means)}")  # noqa: T201
