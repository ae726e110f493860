"""Fig. 7 of RTG-SLAM: ``python docs/measured/disc_depth.py [FOLDER] [VIEWS]``, by default 20 views
of the room. The last line that is printed has the depth errors as JSON."""

import dataclasses
import json
import statistics
import sys

from gsfusion_nb.config import rtg_slam
from gsfusion_nb.data import open_sequence
from gsfusion_nb.mapping.fit_image import fit_image

data = sys.argv[1] if len(sys.argv) > 1 else "room"
views = int(sys.argv[2]) if len(sys.argv) > 2 else 20
sequence = open_sequence(data, data=dataclasses.replace(rtg_slam("room").data, hold_out_every=0))
frames = [sequence[round(i * (len(sequence) - 1) / max(views - 1, 1))] for i in range(views)]
records = []
for n in (500, 1000, 2000, 4000, 8000):
    for method in ("disc", "blended", "round"):
        rows = [fit_image(frame, n, method) for frame in frames]
        means = {name: statistics.fmean(row[name] for row in rows) for name in rows[0]}
        print(f"{n:,} {method}: {'; '.join(f'{k} {v:.2f}' for k, v in means.items())}")  # noqa: T201
        errors = {"mean_cm": "mean depth error, cm", "median_cm": "median depth error, cm"}
        record = {key: means[name] for key, name in errors.items()}
        records.append({"method": method, "n": n} | record)
print(json.dumps(records))  # noqa: T201
