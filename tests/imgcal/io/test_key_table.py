"""Tables of keys with types, defaults and meanings, taken from the fields alone."""

from dataclasses import dataclass
from typing import Annotated, Literal

from pydantic import Field

from imgcal.io import Key, StrictModel, StrictRecord, list_keys


@dataclass(frozen=True)
class Inner(StrictRecord):
    """A record in a record."""

    share: Annotated[float, Field(ge=0, le=1)] = 0.5  # of the whole

    def method(self) -> None:
        share: int = 3  # not a field
        del share


class Base(StrictModel):
    name: str  # for people


class Other(StrictModel):
    speed: float = 2.0


class Outer(Base):
    kind: Literal["a", "b"] = "a"  # which one
    count: Annotated[int, Field(ge=1, le=10**9)]  # how many
    rates: dict[str, float] = Field(default={})  # by name
    silent: bool = False
    limits: tuple[float, float] | None = None  # low, high
    inner: Inner = Inner()  # not told: its own keys are
    either: Inner | Other = Other()


def test_keys_of_a_record() -> None:
    assert list(list_keys(Outer)) == [
        Key("name", "text", "", "for people"),
        Key("kind", "a or b", "a", "which one"),
        Key("count", "integer >= 1", "", "how many"),
        Key("rates", "number by name", "{}", "by name"),
        Key("silent", "true or false", "false", ""),
        Key("limits", "list of number or null", "null", "low, high"),
        Key("inner.share", "number >= 0 and <= 1", "0.5", "of the whole"),
        Key("either.share", "number >= 0 and <= 1", "", "of the whole"),
        Key("either.speed", "number", "", ""),
    ]
    assert next(list_keys(Other, "deep.")).path == "deep.speed"
