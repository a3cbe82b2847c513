"""The pages: built without a warning, every link and every public name leads somewhere, and nothing needs a network."""

import re
from html.parser import HTMLParser
from importlib import import_module
from inspect import isclass, isroutine
from pathlib import Path
from pkgutil import iter_modules
from urllib.parse import unquote

import pytest

import imgcal
from imgcal.training import load_experiment

mkdocs = pytest.importorskip("mkdocs", reason="the extra docs is not installed")

ROOT = Path(__file__).parents[1]
ROOMS = [f"imgcal.{found.name}" for found in iter_modules(imgcal.__path__) if found.ispkg and found.name != "cli"]


class Page(HTMLParser):
    """What a page has and what it leads to."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.names: set[str] = set()
        self.links: list[str] = []
        self.loads: list[str] = []
        self.equations = 0
        self.feed(text)

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        found = {name: value or "" for name, value in attributes}
        self.names.add(found.get("id", ""))
        self.equations += tag == "math"
        if tag == "a" and "href" in found:
            self.links.append(found["href"])
        if tag in ("script", "img", "iframe") and "src" in found:
            self.loads.append(found["src"])
        if tag == "link" and found.get("rel") == "stylesheet":
            self.loads.append(found["href"])


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The pages, built as `scripts/docs` does."""
    # In this process: a new one would import the same libraries once more.
    from mkdocs.commands.build import build
    from mkdocs.config import load_config

    folder = tmp_path_factory.mktemp("site")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(ROOT)
        patch.setenv("NO_MKDOCS_2_WARNING", "1")
        config = load_config(str(ROOT / ".mkdocs.yml"), site_dir=str(folder), strict=True)
        config.plugins.on_startup(command="build", dirty=False)
        build(config)
        config.plugins.on_shutdown()
    return folder


@pytest.fixture(scope="module")
def pages(site: Path) -> dict[Path, Page]:
    return {path: Page(path.read_text()) for path in sorted(site.rglob("*.html")) if path.name != "404.html"}


def test_every_link_leads_somewhere(pages: dict[Path, Page]) -> None:
    broken = []
    for path, page in pages.items():
        for link in page.links:
            target, _, name = unquote(link).partition("#")
            there = (path.parent / target).resolve() if target else path
            found = pages[there].names if there in pages else set()
            if not there.is_file() or (name and there.suffix == ".html" and name not in found):
                broken.append(f"{path.name}: {link}")
    assert not broken, broken


def test_nothing_comes_from_a_network(pages: dict[Path, Page]) -> None:
    for path, page in pages.items():
        for source in page.loads:
            assert (path.parent / source.partition("?")[0]).is_file(), f"{path.name}: {source}"


@pytest.mark.parametrize("room", ["imgcal", *ROOMS, "renderers"])
def test_every_room_has_a_page_with_its_public_names(room: str, pages: dict[Path, Page], site: Path) -> None:
    page = pages[site / "api" / f"{room.removeprefix('imgcal.')}.html"]
    package = import_module(room)
    named = {name.rpartition(".")[2] for name in page.names if name.startswith(room)}
    public = {name for name in package.__all__ if isclass(getattr(package, name)) or isroutine(getattr(package, name))}
    missing = public - named
    assert not missing, missing


def test_equations_are_drawn(pages: dict[Path, Page], site: Path) -> None:
    assert pages[site / "formulation.html"].equations > 50
    for path in pages:
        assert "arithmatex" not in path.read_text(), path.name


def test_fields_tell_their_shapes(site: Path) -> None:
    text = re.sub(r"<[^>]+>", "", (site / "api" / "types.html").read_text())
    assert "(*B, C, D): coefficients in the order of each camera" in text


def test_the_house_is_drawn_with_all_its_rooms() -> None:
    house = (ROOT / "CONTRIBUTING.md").read_text().partition("## Package structure")[2].partition("## ")[0]
    drawn = {name for line in house.splitlines() if line.startswith("    ") for name in re.findall(r"[a-z_]+", line)}
    assert {room.removeprefix("imgcal.") for room in ROOMS} | {"cli", "renderers"} <= drawn


def test_the_experiment_that_is_shown_can_be_trained(tmp_path: Path) -> None:
    shown = re.findall(r"```yaml\n(.*?)```", (ROOT / "docs" / "train.md").read_text(), re.DOTALL)[0]
    path = tmp_path / "my-rig.yaml"
    path.write_text(shown.replace("factory.yaml", "O10").replace("object.csv", "asymmetric8"))
    assert load_experiment(path).training.minutes == 30
