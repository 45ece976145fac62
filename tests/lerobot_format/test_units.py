"""Units come from names, and only where a name says them."""

import pytest

from pipeline.lerobot_format.units import column_names, unit_of


@pytest.mark.parametrize(
    ("name", "unit"),
    [
        ("x_px", "px"),
        ("block_angle_rad", "rad"),
        ("elbow_deg", "deg"),
        ("elbow (deg)", "deg"),
        ("eef_x_m", "m"),
        ("gap_mm", "mm"),
        ("wrist_rad_s", "rad/s"),
        ("wrist.vel_deg_s", "deg/s"),
        ("elbow_flex.pos", None),
        ("joint_0_vel", None),
        ("motor_0", None),
        ("m", None),
        ("arm.m", None),
        ("deg", None),
        ("grad", None),
        ("", None),
    ],
)
def test_units(name: str, unit: str | None):
    assert unit_of(name) == unit


def test_a_feature_of_one_column_without_a_name_has_its_own():
    assert column_names("next.reward", None, 1) == ("reward",)
    assert column_names("action", None, 3) == ("0", "1", "2")
