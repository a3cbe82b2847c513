import json

import pytest

from imgcal.io import read_json
from imgcal.io.json_text import MOST_DEPTH


@pytest.mark.parametrize("value", [None, 3, "text", [1, [2, {"a": [3.5]}]], {"a": {"b": []}}, [], {}])
def test_values_come_back(value) -> None:
    assert read_json(json.dumps(value)) == value


@pytest.mark.parametrize("kind", ["[]", '{"a":}'])
def test_values_are_nested_so_deep_and_no_deeper(kind: str) -> None:
    def nested(depth: int) -> str:
        return kind[:-1] * depth + "0" + kind[-1] * depth

    assert read_json(nested(MOST_DEPTH - 1)) is not None
    for depth in (MOST_DEPTH, 500, 10**6):
        with pytest.raises(ValueError, match="nested more than 32 deep"):
            read_json(nested(depth))


def test_what_is_no_json_is_an_error() -> None:
    for text in ("", "{", "[1,]", "nothing"):
        with pytest.raises(ValueError):
            read_json(text)
