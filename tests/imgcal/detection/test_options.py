import pytest

from imgcal.detection import DetectionOptions
from imgcal.errors import InputError


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"polarity": "grey"}, "polarity: found 'grey', expected one of bright, dark"),
        ({"min_radius": 0.0}, "radius limits: found 0.0 to 16.0"),
        ({"min_radius": 5.0, "max_radius": 4.0}, "radius limits: found 5.0 to 4.0"),
        ({"max_radius": 501.0}, "radius limits"),
        ({"max_radius": float("nan")}, "radius limits"),
        ({"threshold": 0.0}, "threshold: found 0.0"),
        ({"threshold": float("nan")}, "threshold"),
        ({"max_elongation": 1.0}, "max_elongation: found 1.0"),
        ({"bit_depth": 17}, "bit_depth: found 17, expected 8 to 16"),
        ({"saturation": -1.0}, "saturation: found -1.0"),
    ],
)
def test_settings_that_cannot_be_are_named(change, message) -> None:
    with pytest.raises(InputError, match=message):
        DetectionOptions(**change)


def test_what_is_said_of_the_radius_limits_it() -> None:
    assert DetectionOptions().radius_limit == 16.0 and DetectionOptions(max_radius=40.0).radius_limit == 40.0
