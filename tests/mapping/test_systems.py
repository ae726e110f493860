"""Systems by name."""

import pytest

from gsfusion_nb.config import GpsSlamConfig, GSFusionConfig, RtgSlamConfig, gps_slam, gsfusion, rtg_slam
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


def test_a_rule_is_handed_on():
    for config in (gsfusion("room"), rtg_slam("room"), gps_slam("room")):
        assert make_mapper(config, seeding="dense").rule.__name__ == "dense"


def test_unknown_system_lists_the_known():
    with pytest.raises(KeyError, match=r"no system 'rtgslam'; known: gps_slam, gsfusion, .*rtg_slam"):
        get_system("rtgslam")
    assert set(SYSTEMS) >= {"gsfusion", "rtg_slam", "gps_slam"}
