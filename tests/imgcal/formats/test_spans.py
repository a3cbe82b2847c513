import pytest

from imgcal.formats.spans import locate, numbers_in

TEXTS = {
    "yaml": "%YAML:1.0\n---\nä: {b: [1.5, 2]} # 7\nk:\n  data: [ 1., -2.e-3,\n     3 ]\n",
    "toml": '# 9\n[a.b]\nx = 1\nk = [ [1.0, 2], # 5\n [-3e-2] ]\ns = "k = 3 # ]"\n[[c]]\nk = 4\n[[c]]\nk = 5.5\n',
    "json": '{"ä": {"t": "k 1"}, "l": [{"k": 1}, {"k": [2.5, -3]}]}',
    "python": "# 4\n{ 'k': [1.0,  # 2\n 3], 'ü': 1, 'm': -7 }\n",
    "xml": '<?xml version="1.0"?>\n<r n="1"><!--ä 3--><a k=\'ViconRadial2 1 -2e-08\'/><b><data>1 2.\n3</data></b></r>',
    "rows": "# a 1\n1 OPENCV 640 480 1.5\r\n2 R2D2 3\n",
}


@pytest.mark.parametrize(
    ("kind", "keys", "found"),
    [
        ("yaml", ("k", "data"), ["1.", "-2.e-3", "3"]),
        ("yaml", ("ä", "b"), ["1.5", "2"]),
        ("toml", ("a", "b", "k"), ["1.0", "2", "-3e-2"]),
        ("toml", ("c", 1, "k"), ["5.5"]),
        ("json", ("l", 1, "k"), ["2.5", "-3"]),
        ("json", ("l", 0, "k"), ["1"]),
        ("python", ("k",), ["1.0", "3"]),
        ("python", ("m",), ["-7"]),
        ("xml", (2, "@k"), ["1", "-2e-08"]),
        ("xml", ("r", "b", "data"), ["1", "2.", "3"]),
        ("rows", (2,), ["1", "640", "480", "1.5"]),
        ("rows", (3,), ["2", "3"]),
    ],
)
def test_numbers_are_found_where_they_stand(kind: str, keys: tuple[str | int, ...], found: list[str]) -> None:
    text = TEXTS[kind]
    node = locate(text, kind).at(keys)
    assert node is not None
    assert [text[start:end] for start, end in numbers_in(text, node.span, kind)] == found


@pytest.mark.parametrize("kind", ["toml", "json", "python", "xml", "yaml"])
def test_what_cannot_be_followed_is_one_error(kind: str) -> None:
    with pytest.raises(ValueError):
        locate("{[<", kind)
    assert locate(TEXTS[kind], kind).at(("nothing", "there")) is None
