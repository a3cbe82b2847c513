"""Records that are values in Python and blocks of a file alike; YAML files as a whole: test_yaml_file."""

from dataclasses import dataclass
from typing import Annotated

import pytest
from pydantic import Field

from imgcal.errors import InputError
from imgcal.io import StrictModel, StrictRecord, validate


@dataclass(frozen=True)
class Noise(StrictRecord):
    sigma: Annotated[float, Field(ge=0)] = 0.1
    kinds: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.sigma > 5 and not self.kinds:
            raise InputError("sigma above 5 needs a kind")


class Setup(StrictModel):
    noise: Noise = Noise()
    count: int = 1


def test_the_same_record_from_python_and_from_a_mapping() -> None:
    made = validate({"noise": {"sigma": 2, "kinds": ("a", "b")}}, Setup, "here").noise
    assert made == Noise(2.0, ("a", "b")) and isinstance(made, Noise) and isinstance(made.sigma, float)
    assert validate({}, Setup, "here").noise == Noise()


WRONG = [({"sigma": -1.0}, r"sigma: found -1\.0"), ({"sigma": "1"}, "sigma: found '1'")]


@pytest.mark.parametrize(("values", "message"), WRONG)
def test_wrong_values_are_refused_either_way(values, message) -> None:
    with pytest.raises(InputError, match=message):
        Noise(**values)
    with pytest.raises(InputError, match=f"here: noise: {message}"):
        validate({"noise": values}, Setup, "here")


def test_what_fields_must_be_together_is_asked_either_way() -> None:
    with pytest.raises(InputError, match="needs a kind"):
        Noise(sigma=6.0)
    with pytest.raises((InputError, ValueError), match="needs a kind"):
        validate({"noise": {"sigma": 6.0}}, Setup, "here")


def test_misspelt_names_come_before_what_follows_from_them() -> None:
    with pytest.raises(InputError, match="here: noise: unknown key `sgima`, nearest: sigma"):
        validate({"noise": {"sgima": 1.0}}, Setup, "here")
    with pytest.raises(InputError, match="here: unknown key `nose`, nearest: noise"):
        validate({"nose": {}, "count": "many"}, Setup, "here")


def test_records_cannot_be_changed() -> None:
    with pytest.raises(AttributeError):
        Noise().sigma = 3.0  # type: ignore[misc]
