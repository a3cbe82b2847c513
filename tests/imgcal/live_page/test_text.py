import json

import numpy as np
import pytest

from imgcal.live_page import to_json
from imgcal.live_page.page import round_values, stream_event


def test_numbers_are_short_and_what_is_none_is_null():
    values = np.array([[0.0, -1.23456789e-7], [np.inf, 123456.789]])
    assert round_values(values) == [[0.0, -1.2346e-07], [None, 123460.0]]
    assert round_values(np.zeros((0, 3))) == []


def test_json_stands_safely_inside_of_a_script():
    hostile = "</script><!--&"
    text = to_json({"name": hostile})
    assert not set("<>&") & set(text) and json.loads(text)["name"] == hostile
    with pytest.raises(ValueError):
        to_json(float("nan"))


def test_an_event_of_the_stream_is_two_lines():
    assert stream_event("state", {"text": "a\nb"}) == b'event: state\ndata: {"text":"a\\nb"}\n\n'
