"""Examples in docstrings, in the README and on the pages run, and print what is shown."""

import doctest
import re
from importlib import import_module
from inspect import isclass, isfunction, isroutine
from pathlib import Path

import pytest

import imgcal

ROOT = Path(__file__).parents[1]
OPTIONS = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE
SHOWN = ">>> "
MODULES = [
    ".".join(path.relative_to(ROOT).with_suffix("").parts)
    for room in ("imgcal", "renderers")
    for path in sorted((ROOT / room).rglob("*.py"))
    if SHOWN in path.read_text()
]
PAGES = [path for path in (ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))) if SHOWN in path.read_text()]


def run(tests: list[doctest.DocTest]) -> None:
    """Run examples and show, line by line, what came instead of what stands there."""
    report: list[str] = []
    runner = doctest.DocTestRunner(optionflags=OPTIONS)
    for test in tests:
        runner.run(test, out=report.append)
    assert not report, "".join(report)


@pytest.mark.parametrize("name", MODULES)
def test_examples_in_docstrings(name: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)
    module = import_module(name)
    # Those that are compiled or under a decorator are overlooked by the finder.
    inner = [getattr(value, "__wrapped__", getattr(value, "py_func", None)) for value in vars(module).values()]
    objects = [module, *(value for value in inner if isfunction(value) and value.__module__ == name)]
    run([test for value in objects for test in doctest.DocTestFinder().find(value, module=module) if test.examples])


@pytest.mark.parametrize("path", PAGES, ids=lambda path: path.name)
def test_examples_on_pages(path: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)
    text = re.sub(r"```\w*", "", path.read_text())  # an empty line, where an answer ends
    run([doctest.DocTestParser().get_doctest(text, {}, path.name, str(path), 0)])


@pytest.mark.parametrize("name", imgcal.__all__)
def test_every_name_at_the_top_has_an_example(name: str) -> None:
    found = getattr(imgcal, name)
    assert isclass(found) or isroutine(found)
    assert SHOWN in (found.__doc__ or ""), f"imgcal.{name} has no example"
