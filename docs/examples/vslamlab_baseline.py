"""gsfusion_nb as a baseline of VSLAM-LAB (Fontan et al. 2025): RGB-D sequences, tracked and mapped.

Copy this file to VSLAM-LAB's Baselines/baseline_files, import ``GSFUSIONNB_baseline`` in
Baselines/get_baseline.py, and add a line for each system there:
``"gsfusion": lambda: GSFUSIONNB_baseline("gsfusion")``. gsfusion_nb is installed in any Python of
its own, which GSFUSION_PYTHON names. The maps, numbers and report of a run lie beside its
trajectory.
"""

import argparse
import csv
import os
import shlex
import sys
from pathlib import Path

try:
    from Baselines.BaselineVSLAMLab import BaselineVSLAMLab  # pyright: ignore[reportMissingImports]
except ImportError:
    BaselineVSLAMLab = object  # run as a program, by gsfusion_nb's Python


class GSFUSIONNB_baseline(BaselineVSLAMLab):
    """What VSLAM-LAB asks of a baseline."""

    def __init__(self, system: str = "gsfusion"):
        super().__init__(system, "gsfusion_nb", {"mode": "rgbd", "width": 320, "height": 240})  # pyright: ignore
        self.modes = ["rgbd"]

    def build_execute_command(self, exp_it, exp, dataset, sequence_name) -> str:
        """The command line of one run."""
        sequence = dataset.dataset_path / sequence_name
        folder = Path(exp.folder) / dataset.dataset_folder
        folder /= sequence_name
        given = {
            name: exp.parameters.get(name, value) for name, value in self.default_parameters.items()
        }
        given |= {
            "system": self.baseline_name,
            "sequence_path": sequence,
            "rgb_csv": folder / "rgb_exp.csv",
        }
        given |= {
            "calibration_yaml": sequence / "calibration.yaml",
            "exp_folder": folder,
            "exp_it": exp_it,
        }
        program = [os.environ.get("GSFUSION_PYTHON", "python3"), str(Path(__file__).resolve())]
        return shlex.join([*program, *(f"--{name}={value}" for name, value in given.items())])

    def is_installed(self) -> tuple[bool, str]:
        """Nothing is cloned or installed by VSLAM-LAB."""
        return True, "in the Python that GSFUSION_PYTHON names"

    is_cloned = is_installed


def read_sequence(args: argparse.Namespace):
    """The frames that the experiment chose, undistorted, without poses.

    Raises:
        SequenceError: no RGB-D camera in the calibration, or a lens that is not known.
    """
    import yaml

    from gsfusion_nb.data import SequenceError
    from gsfusion_nb.data.lens import CameraModel, Undistorter
    from gsfusion_nb.data.recorded.poses import no_poses
    from gsfusion_nb.data.recorded.recorded_sequence import RecordedSequence
    from gsfusion_nb.types import Camera

    cameras = yaml.safe_load(
        args.calibration_yaml.read_text(encoding="utf-8").removeprefix("%YAML:1.0")
    )["cameras"]
    told = next((camera for camera in cameras if camera.get("cam_type") == "rgb+depth"), None)
    kind = (told or {}).get("distortion_type", "radtan4")
    if told is None or kind not in ("radtan4", "radtan5", "equid4"):
        raise SequenceError(
            f"{args.calibration_yaml}: expected a camera of type rgb+depth, radtan or equid; got "
            f"{told}"
        )
    width, height = told["image_dimension"]
    fx, fy = told["focal_length"]
    cx, cy = told["principal_point"]
    pinhole = Camera(
        width=int(width),
        height=int(height),
        fx=fx,
        fy=fy,
        cx=cx + 0.5,
        cy=cy + 0.5,
    )
    lens = CameraModel(
        pinhole, tuple(told.get("distortion_coefficients", ())), fisheye=kind == "equid4"
    )
    undistorter = None if lens.is_pinhole else Undistorter(lens)
    with open(args.rgb_csv, newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
        rgb = told["cam_name"]
        depth = told["depth_name"]
    return RecordedSequence(
        name=args.sequence_path.name,
        camera=undistorter.camera if undistorter else pinhole,
        rgb_files=[args.sequence_path / row[f"path_{rgb}"] for row in rows],
        depth_files=[args.sequence_path / row[f"path_{depth}"] for row in rows],
        timestamps_s=[int(row[f"ts_{rgb} (ns)"]) / 1e9 for row in rows],
        depth_times_s=[int(row[f"ts_{depth} (ns)"]) / 1e9 for row in rows],
        poses=no_poses(len(rows)),
        pose_sources=[""] * len(rows),
        has_poses=False,
        depth_scale=float(told["depth_factor"]),
        rectification=undistorter,
    ), [row[f"ts_{rgb} (ns)"] for row in rows]


def main(arguments: list[str] | None = None) -> int:
    """Map one sequence and write its trajectory as VSLAM-LAB expects it."""
    from gsfusion_nb.geometry.quaternion import from_matrix
    from gsfusion_nb.mapping import get_system
    from gsfusion_nb.runs import run_mapping

    parser = argparse.ArgumentParser(description=__doc__)
    kinds = dict.fromkeys(("sequence_path", "calibration_yaml", "rgb_csv", "exp_folder"), Path)
    for name, kind in (kinds | {"system": str, "exp_it": int, "width": int, "height": int}).items():
        parser.add_argument(f"--{name}", type=kind, required=True)
    args, _ = parser.parse_known_args(arguments)
    sequence, stamps = read_sequence(args)
    size = {"data__width": args.width, "data__height": args.height, "data__hold_out_every": 0}
    config = get_system(args.system).preset("online", tracking__poses="tracked", **size)
    run = run_mapping(sequence, config, folder=args.exp_folder / f"{args.exp_it:05}_{args.system}")
    trajectory = run.mapper.trajectory
    with open(
        args.exp_folder / f"{args.exp_it:05}_KeyFrameTrajectory.csv",
        "w",
        newline="",
        encoding="utf-8",
    ) as file:
        writer = csv.writer(file)
        writer.writerow(["ts (ns)", "tx (m)", "ty (m)", "tz (m)", "qx", "qy", "qz", "qw"])
        for index, T_WC in zip(trajectory.frame_indices, trajectory.poses, strict=True):
            w, x, y, z = from_matrix(T_WC[:3, :3]).tolist()
            writer.writerow([stamps[index], *T_WC[:3, 3].tolist(), x, y, z, w])
    return 0


if __name__ == "__main__":
    sys.exit(main())
