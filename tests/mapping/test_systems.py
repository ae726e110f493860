"""Systems by name."""

import pytest

from gsfusion_nb.config import GpsSlamConfig, GSFusionConfig, RtgSlamConfig
from gsfusion_nb.config.gsfusion import presets
from gsfusion_nb.mapping import GPSSLAM, RTGSLAM, SYSTEMS, GSFusion, get_system, make_mapper, system_of


@pytest.mark.parametrize(
    ("name", "config", "mapper"),
    [
        ("gsfusion", GSFusionConfig, GSFusion),
        ("rtg_slam", RtgSlamConfig, RTGSLAM),
        ("gps_slam", GpsSlamConfig, GPSSLAM),
    ],
)
def test_settings_mapper_and_name_belong_together(name, config, mapper):
    system = get_system(name)
    assert (system, system.config_type) == (mapper, config)
    settings = system.preset("room")
    made = make_mapper(settings)
    assert type(settings) is config
    assert type(made) is mapper
    assert made.config is settings
    assert system_of(settings) == system_of(made.config) == name


@pytest.mark.parametrize("system", SYSTEMS)
@pytest.mark.parametrize("preset", presets())
def test_every_system_has_every_preset(system, preset):
    for fidelity in SYSTEMS[system].fidelities:
        config = SYSTEMS[system].preset(preset, fidelity)
        assert SYSTEMS[system].fidelity_of(config) == fidelity
