"""One grammar of settings: the same options for every command that maps, in any order."""

import itertools
import json

import pytest

from gsfusion_nb.cli import main
from gsfusion_nb.cli.live import FolderOptions
from gsfusion_nb.cli.map import MapOptions
from gsfusion_nb.cli.settings import parse
from gsfusion_nb.config import gps_slam, gsfusion, replace, rtg_slam, to_dict
from gsfusion_nb.config.values import leaves
from gsfusion_nb.mapping import SYSTEMS

PARTS = [
    ["room"],
    ["--device", "cpu"],
    ["--sh-degree", "1"],
    ["--reader", "n_frames=9"],
    ["--no-evaluate"],
]
"""A list of values, such as that of --reader, ends with the next option, so the scene must not
follow it."""


def settings(*arguments: str):
    return parse(MapOptions, "map", list(arguments), data="data").settings()


@pytest.mark.parametrize(
    "parts",
    [PARTS[i:] + PARTS[:i] for i in range(len(PARTS))],
)
def test_the_order_of_options_does_not_matter(parts):
    arguments = list(itertools.chain(*parts))
    options = parse(MapOptions, "map", arguments, data="data")
    assert (options.data, options.device, options.evaluate, options.reader) == (
        "room",
        "cpu",
        False,
        ("n_frames=9",),
    )
    assert options.config == gsfusion("room", sh_degree=1)


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["room"], gsfusion("room")),
        (["--device", "cpu", "room"], gsfusion("room")),
        (
            ["--data.stop", "6", "room", "--tsdf.far-m", "3"],
            gsfusion("room", data__stop=6, tsdf__far_m=3.0),
        ),
        (["recording", "--out", "room"], gsfusion("replica")),
        (["recording"], gsfusion("replica")),
        (["--preset", "tum", "room"], gsfusion("tum")),
        (["room", "--preset=tum"], gsfusion("tum")),
        (["room", "--fidelity", "paper"], gsfusion("room", "paper")),
        (["--fidelity=code", "recording", "--seed", "4"], gsfusion("replica", "code", seed=4)),
        (["--system", "rtg_slam", "room"], rtg_slam("room")),
        (["--system", "gps_slam", "room", "--fidelity", "code"], gps_slam("room", "code")),
        (["room", "--system=rtg_slam", "--fidelity", "paper"], rtg_slam("room", "paper")),
        (
            ["recording", "--fidelity=code", "--preset", "tum", "--system", "rtg_slam"],
            rtg_slam("tum", "code"),
        ),
        (
            ["room", "--rule-options", "fraction=0.1"],
            gsfusion("room", seeding__options={"fraction": 0.1}),
        ),
    ],
)
def test_system_and_preset_are_found_wherever_they_stand(arguments, expected):
    assert settings(*arguments) == expected


def test_settings_of_an_earlier_run_are_a_start(tmp_path):
    path = tmp_path / "config.json"
    earlier = rtg_slam("tum", sh_degree=1)
    path.write_text(json.dumps({"system": "rtg_slam", "config": to_dict(earlier)}))
    options = parse(
        MapOptions, "map", ["room", "--seed", "3", "--from-config", str(path)], data="data"
    )
    assert options.settings() == replace(earlier, seed=3)


BEFORE = {
    "gsfusion": {
        "keyframe_max_gap": 0,
        "optim.depth_weight": 0.0,
        "optim.depth_over_alpha": False,
        "tsdf.colour_band_voxels": 0.0,
    },
    "rtg_slam": {"states.age": "all", "tracking.landmarks": False, "tracking.brightness_m": None},
    "gps_slam": {"residual.loss": "l1", "schedule.recalled_new": 0, "tracking.pose_jumps": "map"},
}
"""Settings that came after their system, with what runs did before."""


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (
            ["recording", "--preset", "scannetpp", "--system", "rtg_slam"],
            "preset scannetpp sets states.unstable_frames 200; the rest is the default",
        ),
        (
            ["recording", "--preset", "tum"],
            "preset tum sets optim.global_iterations 20; the rest is the default",
        ),
        (
            ["recording", "--preset", "online"],
            "preset online sets optim.global_iterations 0; the rest is the default",
        ),
        (["recording", "--preset", "scannetpp", "--fidelity", "code"], ""),
        (["recording"], ""),
        (["room", "--preset", "room"], ""),
        (["recording", "--preset", "tum", "--system", "gps_slam"], ""),
    ],
)
def test_what_a_preset_sets_besides_the_data_is_said(arguments, said):
    assert parse(MapOptions, "map", arguments, data="data").said_of_preset() == said


@pytest.mark.parametrize("system", SYSTEMS)
def test_a_run_from_before_a_setting_existed_keeps_what_it_did(tmp_path, system):
    path = tmp_path / "config.json"
    default = SYSTEMS[system].config_type()
    stored = to_dict(default)
    for name in BEFORE[system]:
        *group, last = name.split(".")
        del (stored[group[0]] if group else stored)[last]
    path.write_text(json.dumps({"system": system, "config": stored}))
    options = parse(MapOptions, "map", ["room", "--from-config", str(path)], data="data")
    values = leaves(to_dict(options.settings()))
    assert {name: values[name] for name in BEFORE[system]} == BEFORE[system]
    others = {
        name: value
        for name, value in leaves(to_dict(default)).items()
        if name not in BEFORE[system]
    }
    assert others.items() <= values.items()


@pytest.mark.parametrize(
    ("system", "preset"),
    [("gsfusion", gsfusion), ("rtg_slam", rtg_slam), ("gps_slam", gps_slam)],
)
def test_a_live_folder_takes_the_same_options(system, preset):
    arguments = ["--tracking.poses", "tracked", "scan", "--sh-degree", "0", "--system", system]
    options = parse(FolderOptions, "live folder", arguments)
    assert options.path == "scan"
    assert options.settings() == preset("replica", tracking__poses="tracked", sh_degree=0)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            ["room", "--system", "rtgslam"],
            "no system 'rtgslam'; known: gps_slam, gsfusion, rtg_slam",
        ),
        (["room", "--preset", "repilca"], "no preset 'repilca'; known:"),
        (
            ["room", "--system", "rtg_slam", "--fidelity", "papre"],
            "has no --fidelity papre; known: measured, paper",
        ),
        (
            ["room", "--fidelity", "printed"],
            "no --fidelity printed; known: measured, paper_steps, paper, code",
        ),
        (
            ["room", "--from-config", __file__],
            "is not valid JSON .*; expected the config.json of a run",
        ),
        (["room", "--rule-options", "share"], "expected an option as name=value, got 'share'"),
    ],
)
def test_mistakes_are_sentences(arguments, message):
    with pytest.raises((KeyError, ValueError), match=message):
        settings(*arguments)


@pytest.mark.parametrize(
    "command", ["map", "convert", "check", "bench", "study", "eval", "live folder"]
)
def test_help_is_wrapped_to_the_terminal_and_shows_no_empty_defaults(command, capsys, monkeypatch):
    """Lines of the help end where the next word would not fit, not where the source has a line
    break."""
    monkeypatch.setenv("COLUMNS", "100")
    with pytest.raises(SystemExit) as ended:
        main([*command.split(), "--help"])
    assert ended.value.code == 0
    text = capsys.readouterr().out
    assert "(default: )" not in text
    assert "(default: '')" not in text
    lines = [line[1:-1].rstrip() for line in text.splitlines() if line.startswith("│")]
    for line, following in itertools.pairwise(lines):
        goes_on = (
            following.startswith("      ")
            and line.startswith("      ")
            and not following.strip().startswith("--")
        )
        if goes_on and line.strip() and following.strip():
            first = following.split()[0]
            assert len(line) + 1 + len(first) > 94, f"{line!r} has room for {first!r}"


def test_a_run_with_a_rule_of_one_s_own_is_not_repeated_without_it(tmp_path):
    path = tmp_path / "config.json"
    document = {
        "system": "gsfusion",
        "rule": "mine",
        "rule_is_built_in": False,
        "config": to_dict(gsfusion("room")),
    }
    path.write_text(json.dumps(document))
    with pytest.raises(
        ValueError, match=r"seeding rule 'mine', which is not part of this package.*rule.py"
    ):
        parse(MapOptions, "map", ["room", "--from-config", str(path)], data="data")
    options = parse(
        MapOptions,
        "map",
        ["room", "--from-config", str(path), "--seeding.rule", "uniform"],
        data="data",
    )
    assert options.config.seeding.rule == "uniform"
    for more in (["--fidelity", "paper"], ["--preset", "tum"], ["--system", "rtg_slam"]):
        with pytest.raises(ValueError, match=f"leave out {more[0]}, or --from-config"):
            parse(MapOptions, "map", ["room", "--from-config", str(path), *more], data="data")
