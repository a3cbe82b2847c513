"""The structure that CONTRIBUTING draws: imports point down, rooms export what others use, tests mirror the tree."""

import ast
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


# Modules whose tests stand elsewhere, or that hold no logic.
TESTED_ELSEWHERE = {
    "imgcal/association/options.py": "values only",
    "imgcal/association/result.py": "values only",
    "imgcal/cli/arguments.py": "values only; test_imports, cli/test_help",
    "imgcal/cli/detect.py": "cli/test_main, test_warmup",
    "imgcal/pipeline/calibration.py": "pipeline/test_recalibration",
    "imgcal/pipeline/fitting.py": "pipeline/test_recalibration, test_from_scratch",
    "imgcal/cli/findings.py": "cli/test_calibrate; pipeline/test_camera_motion, test_knowledge",
    "imgcal/cli/interruption.py": "cli/test_main, in processes of their own",
    "imgcal/cli/training_folder.py": "training/test_engine, cli/test_train",
    "imgcal/cli/warmup.py": "online/test_warmup",
    "imgcal/formats/format.py": "values only",
    "imgcal/formats/limits.py": "values only",
    "imgcal/evaluation/plots.py": "evaluation/test_tables",
    "imgcal/evaluation/summary.py": "evaluation/test_tables",
    "imgcal/online/sequential_test.py": "a protocol; online/test_keeper",
    "imgcal/live_page/process.py": "live_page/test_server, test_live_page: a process of its own",
    "imgcal/geometry/lens_model.py": "values only",
    "imgcal/pipeline/labelled_capture.py": "pipeline/test_recalibration, test_steadiness",
    "imgcal/synthesis/hand_held.py": "values only; synthesis/test_volumes",
    "imgcal/synthesis/lens.py": "values only; synthesis/test_arrangements",
    "imgcal/synthesis/physical_drift.py": "synthesis/test_rigs, beside the paper's drift",
    "imgcal/training/callbacks.py": "training/test_engine",
    "imgcal/training/continuation.py": "training/test_engine, test_processes",
    "imgcal/training/run.py": "values only; training/test_engine",
    "imgcal/watch/timing.py": "values only; watch/test_synchronization",
    "renderers/clutter_model.py": "values only; test_clutter",
    "renderers/sensor_model.py": "values only; test_sensor, test_infrared",
}


def test_tests_mirror_the_tree() -> None:
    modules = [path for package in ("imgcal", "renderers") for path in (ROOT / package).rglob("*.py")]
    names = [path.relative_to(ROOT) for path in modules if path.name not in ("__init__.py", "__main__.py")]
    without = {str(name) for name in names if not (ROOT / "tests" / name.with_name(f"test_{name.name}")).is_file()}
    # Operators of PyTorch only wrap: test_operators and imgcal/nn try them all.
    assert {name for name in without if not name.endswith("_operator.py")} == set(TESTED_ELSEWHERE)
