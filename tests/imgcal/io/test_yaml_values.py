import itertools

import pytest
import yaml

from imgcal.io import data_path, yaml_file
from imgcal.io.yaml_file import MOST_DEPTH, read_values


@pytest.mark.parametrize("path", sorted(data_path().rglob("*.yaml")), ids=lambda path: path.stem)
def test_shipped_files_are_read_as_by_pyyaml(path):
    content = path.read_bytes()
    expected = yaml.safe_load(content)
    if "corruption" in expected and False in expected["corruption"]:
        expected["corruption"]["false"] = expected["corruption"].pop(False)
    found = read_values(content)
    # YAML 1.1 takes 1e-5 for text.
    assert found == expected or [type(v) for v in found.values()] == [type(v) for v in expected.values()]


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("a: [1, -2, 1e-5, .5, 1., true, ~, 'x', \"1\", 07, 0x10, 2001-01-01, =]",
         {"a": [1, -2, 1e-5, 0.5, 1.0, True, None, "x", "1", 7, 16, "2001-01-01", "="]}),
        ("1: 2\nfalse: 3\n2001-01-01: 4\n'': 5", {"1": 2, "false": 3, "2001-01-01": 4, "": 5}),
        ("", None),
        ("a: &x [1, {b: 2}]\nc: *x", {"a": [1, {"b": 2}], "c": [1, {"b": 2}]}),
        ("a: &x {k: 1, m: 2}\nb: {<<: *x, m: 5}", {"a": {"k": 1, "m": 2}, "b": {"k": 1, "m": 5}}),
        ("<<: [&x {k: 1}, &y {k: 2, m: 3}]\nm: 4", {"k": 1, "m": 4}),
        ("'<<': 1", {"<<": 1}),
        ("a: !!str 1\nb: !!int '2'\nc: !!float 3", {"a": "1", "b": 2, "c": 3.0}),
    ],
)  # fmt: skip
def test_values(text, expected):
    assert read_values(text.encode()) == expected


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("[" * 100, f"more than {MOST_DEPTH} nested levels"),
        ("{a: " * 100, f"more than {MOST_DEPTH} nested levels"),
        ("- " * 100_000, f"more than {MOST_DEPTH} nested levels"),
        ("a: &a [*a]", "alias"),
        ("a: *b", "alias"),
        ("a: &a 1\n*a : 2", "as a key"),
        ("? [a]\n: 1", "as a key"),
        ("a: 1\na: 2", "`a` given twice"),
        ("1: 1\n1: 2", "`1` given twice"),
        ("a: 1\n---\nb: 2", "second document"),
        ("<<: 3", "merge key"),
        ("!!int ''", "type int"),
        ("!!bool x", "type bool"),
        ("!!float x", "type float"),
        ("!!timestamp x", "tag !!timestamp"),
        ("!!map [a]", "tag !!map"),
        ("!!seq 3", "tag !!seq"),
        ("!!set {a}", "tag !!set"),
        ("!!binary aaa", "tag !!binary"),
        ("!!python/object/apply:os.system [ls]", "tag !!python"),
        ("!own 3", "tag !own"),
        ("a: " + "9" * 5000, "type int"),
    ],
)  # fmt: skip
def test_what_no_file_of_ours_holds(text, problem):
    with pytest.raises(yaml.MarkedYAMLError) as caught:
        read_values(text.encode())
    assert problem in caught.value.problem
    assert len(caught.value.problem) < 200


@pytest.mark.parametrize("text", ["[" * 100_000, "{a: " * 100_000])
def test_brackets_deeper_than_any_stack(text):
    # libyaml looks ahead for the end of a key, and newer versions stop there by themselves.
    with pytest.raises(yaml.MarkedYAMLError, match=f"more than {MOST_DEPTH} nested levels|maximum nesting depth"):
        read_values(text.encode())


def bomb(first: str, step: str) -> str:
    names = [f"a{i}" for i in range(12)]
    lines = [f"{names[0]}: &{names[0]} {first}"]
    lines += [f"{b}: &{b} {step.format(', '.join([f'*{a}'] * 10))}" for a, b in itertools.pairwise(names)]
    return "\n".join(lines)


@pytest.mark.parametrize("text", [bomb("[x]", "[{}]"), bomb("{x: 1}", "{{<<: [{}]}}"), "[" + "x," * 2000 + "]"])
def test_bombs_are_counted_and_not_built(text, monkeypatch):
    built = []
    monkeypatch.setattr(yaml_file, "MOST_VALUES", 1000)
    add = yaml_file._Builder._add
    monkeypatch.setattr(yaml_file._Builder, "_add", lambda *given: built.append(1) or add(*given))
    with pytest.raises(yaml.MarkedYAMLError, match="more than 1,000 values"):
        read_values(text.encode())
    assert len(built) <= 1000
