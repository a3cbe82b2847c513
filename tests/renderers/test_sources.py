import importlib
import sys
from pathlib import Path

import pytest

from renderers.sources import _digest, _imported_modules, _source, source_digest


@pytest.fixture(autouse=True)
def _read_again():
    for name in ("estimation.linearization_cpu", "geometry.projection_cpu", "geometry.transforms"):
        importlib.import_module(f"imgcal.{name}")
    for cached in (_digest, _imported_modules, _source):
        cached.cache_clear()
    yield
    for cached in (_digest, _imported_modules, _source):
        cached.cache_clear()


@pytest.mark.parametrize(
    ("changed", "counts"),
    [
        ("imgcal.geometry.lens_kernels", True),
        ("imgcal.geometry.brown_conrady", True),  # by way of lenses.py
        ("imgcal.geometry.elementary", True),  # by way of equidistant.py
        ("imgcal.geometry.transforms", False),
    ],
)
def test_a_digest_changes_with_all_that_is_imported(
    changed: str, counts: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    module = sys.modules[changed]
    before = source_digest("imgcal.geometry.lens_kernels")
    edited = tmp_path / "edited.py"
    edited.write_text(Path(module.__file__ or "").read_text() + "\n")
    monkeypatch.setattr(module, "__file__", str(edited))
    for cached in (_digest, _imported_modules, _source):
        cached.cache_clear()
    assert (source_digest("imgcal.geometry.lens_kernels") != before) == counts


def test_a_name_that_a_package_lends_is_that_of_its_module() -> None:
    assert "imgcal.geometry.kernels" in _imported_modules("imgcal.estimation.linearization_cpu")
    assert "imgcal.geometry.lens_kernels" in _imported_modules("imgcal.geometry.projection_cpu")


def test_what_has_no_file_has_a_digest_nevertheless() -> None:
    assert source_digest("sys") == source_digest("sys") != source_digest("builtins")
