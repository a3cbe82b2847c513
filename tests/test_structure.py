"""The structure drawn in CONTRIBUTING: imports point down, rooms export what others use, each room has tests."""

import ast
import re
import tomllib
from importlib.metadata import packages_distributions
from pathlib import Path

from importlinter.cli import EXIT_STATUS_SUCCESS, lint_imports

ROOT = Path(__file__).parents[1]
SOURCES = sorted(path for path in (ROOT / "imgcal").rglob("*.py") if path.name != "__main__.py")  # imports step by step


def imports(path: Path) -> list[tuple[str, str]]:
    """Every `from MODULE import NAME` of a file, as (module, name)."""
    nodes = (node for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.ImportFrom))
    return [(node.module or "", alias.name) for node in nodes for alias in node.names]


def room_of(path: Path) -> str:
    return path.relative_to(ROOT / "imgcal").parts[0].removesuffix(".py")


def test_imports_point_down() -> None:
    config = str(ROOT / "pyproject.toml")
    assert lint_imports(config_filename=config, cache_dir=None) == EXIT_STATUS_SUCCESS


def test_rooms_know_each_other_by_what_they_export() -> None:
    inside = [
        f"{path.relative_to(ROOT)}: {module}.{name}"
        for path in SOURCES
        for module, name in imports(path)
        if module.startswith("imgcal.") and module.count(".") > 1 and module.split(".")[1] != room_of(path)
    ]
    assert not inside, inside


def test_private_names_stay_where_they_are() -> None:
    taken = [
        f"{path.relative_to(ROOT)}: {module}.{name}"
        for path in SOURCES
        for module, name in imports(path)
        if module.startswith(("imgcal", "renderers")) and name.startswith("_") and name != "__version__"
    ]
    assert not taken, taken


def test_each_room_has_its_tests() -> None:
    for package in ("imgcal", "renderers"):
        modules = [path for path in (ROOT / package).rglob("*.py") if not path.name.startswith("__")]
        rooms = {path.parent.relative_to(ROOT) for path in modules} - {Path("imgcal")}
        without = [str(room) for room in rooms if not list((ROOT / "tests" / room).glob("test_*.py"))]
        assert not without, without


def test_types_are_checked_without_the_peers_of_the_benchmarks() -> None:
    """A newcomer's environment has no peers: mypy must not look for those that a file imports by name."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    peers = {re.split("[>=<[]", need)[0] for need in project["project"]["optional-dependencies"]["peers"]}
    modules = {module for module, distributions in packages_distributions().items() if peers & set(distributions)}
    overrides = [one for one in project["tool"]["mypy"]["overrides"] if one.get("ignore_missing_imports")]
    ignored = {module.removesuffix(".*") for one in overrides for module in one["module"]}
    for path in [*(ROOT / "scripts").rglob("*.py"), *(ROOT / "tests").rglob("*.py")]:
        for node in ast.walk(ast.parse(path.read_text())):
            names = [one.name for one in node.names] if isinstance(node, ast.Import) else []
            names += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            missing = {name.split(".")[0] for name in names} & (modules - ignored)
            assert not missing, f"{path.relative_to(ROOT)}: {missing}: import_module, or an override in pyproject.toml"
