from imgcal.types import MOST_LIGHTS, UnknownLights, check_object


def test_lights_have_places_and_no_shape() -> None:
    lights = UnknownLights.of()
    check_object(lights)
    assert lights.num_fiducials == MOST_LIGHTS
    assert lights.exact
    assert lights.pose_rank == 3
    assert UnknownLights.of(3).num_fiducials == 3
