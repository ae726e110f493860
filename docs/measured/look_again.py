"""A recording walked forth and back:
``python docs/measured/look_again.py FOLDER SYSTEM SEED [always]``.

With ``always``, keyframes and seeds of GPS-SLAM also come where the camera has been before.
"""

import dataclasses
import json
import sys

from gsfusion_nb.config import DataConfig
from gsfusion_nb.data import open_sequence
from gsfusion_nb.mapping import tsdf_mapping
from gsfusion_nb.mapping.step_report import psnr_from_mse
from gsfusion_nb.mapping.systems import SYSTEMS

ROUNDS = 6
folder, name, seed, *always = sys.argv[1:]
if always:
    tsdf_mapping.SEEN_WITHIN_M = -1.0
sequence = open_sequence(folder, data=DataConfig(width=320, height=240, hold_out_every=8))
walk = [sequence.mapping[i] for i in range(len(sequence.mapping))]
held_out = [sequence.held_out[i] for i in range(len(sequence.held_out))]
mapper = SYSTEMS[name](SYSTEMS[name].preset("replica", seed=int(seed)))
rounds = []
for frames in (walk, walk[::-1]) * (ROUNDS // 2):
    for frame in frames:
        mapper.step(
            dataclasses.replace(frame, index=mapper.n_frames, timestamp_s=mapper.n_frames / 30)
        )
    pictures = [
        (mapper.render(f.camera, f.T_WC).rgb.clamp(0, 1) - f.rgb).square().mean() for f in held_out
    ]
    psnr_db = sum(psnr_from_mse(float(mse)) for mse in pictures) / len(pictures)
    rounds.append(
        {"psnr": psnr_db, "gaussians": len(mapper.gaussians), "keyframes": len(mapper.keyframes)}
    )
print(json.dumps([{"round": i + 1, **numbers} for i, numbers in enumerate(rounds)]))  # noqa: T201
