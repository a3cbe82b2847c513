"""The page as a whole: valid, self-contained, safe, complete, of bounded size."""

from __future__ import annotations

import base64
import hashlib
import json
import re
from collections import Counter
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest

from imgcal.errors import InputError
from imgcal.report import ReportContent, SnapshotSummary, overlay, render, write_report
from tests.imgcal.report.browser import measured

if TYPE_CHECKING:
    from playwright.sync_api import BrowserContext

KINDS = ("content", "refused_content", "single_content", "plain_content", "empty_content")
SECTIONS = ["status", "residuals", "coverage", "accuracy", "rig", "overlays", "cameras", "knowledge", "run"]
VOID = {"meta", "input", "br", "hr", "img", "link"}
HOSTILE = "<img src=x onerror=alert(1)></script>&amp;\"'{{7*7}}"


class Page(HTMLParser):
    """Parse strictly: every element is closed by its own end tag."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.elements: list[tuple[str, dict[str, str]]] = []
        self.scripts: list[str] = []
        self.figures: dict[str, dict[str, object]] = {}
        self.text = ""
        self.feed(html)
        self.close()
        assert not self.open

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, {name: value or "" for name, value in attrs}))
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, {name: value or "" for name, value in attrs}))

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if self.open and self.open[-1] == "script":
            attributes = self.elements[-1][1]
            if attributes.get("type") == "application/json":
                self.figures[attributes["id"]] = json.loads(data)
            else:
                self.scripts.append(data)
        elif not self.open or self.open[-1] != "style":
            self.text += data


@pytest.fixture(scope="module", params=KINDS)
def page(request: pytest.FixtureRequest) -> Page:
    """Each kind of report, parsed."""
    return Page(render(request.getfixturevalue(request.param)))


def test_ids_are_unique_and_links_lead_somewhere(page: Page) -> None:
    ids = Counter(attributes["id"] for _, attributes in page.elements if "id" in attributes)
    assert max(ids.values()) == 1
    targets = [a["href"].removeprefix("#") for tag, a in page.elements if tag == "a"]
    targets += [a["for"] for _, a in page.elements if "for" in a]
    targets += [a["aria-labelledby"] for _, a in page.elements if "aria-labelledby" in a]
    targets += [a["href"].removeprefix("#") for tag, a in page.elements if tag == "use"]
    assert targets
    assert set(targets) <= set(ids)


def test_all_sections_in_order(page: Page) -> None:
    assert [a["id"] for tag, a in page.elements if tag == "section"] == SECTIONS


def test_pictures_have_names_and_controls_have_labels(page: Page) -> None:
    for _, attributes in page.elements:
        if attributes.get("role") == "img":
            assert attributes["aria-label"]
    buttons = [a for tag, a in page.elements if tag == "button"]
    assert all(a["type"] == "button" for a in buttons)


def test_nothing_is_fetched(page: Page) -> None:
    for tag, attributes in page.elements:
        assert tag not in {"link", "iframe", "object", "embed", "img", "base"}
        assert "src" not in attributes
        assert attributes.get("href", "#").startswith("data:image/webp;base64," if tag == "image" else "#")
        assert not any(name.startswith("on") for name in attributes)
    assert "url(" not in "".join(str(a) for _, a in page.elements)


def test_policy_forbids_connections_and_allows_exactly_the_scripts(page: Page) -> None:
    policy = next(a["content"] for tag, a in page.elements if a.get("http-equiv") == "Content-Security-Policy")
    assert policy.startswith("default-src 'none'; ")
    hashes = {base64.b64encode(hashlib.sha256(script.encode()).digest()).decode() for script in page.scripts}
    assert len(page.scripts) == 2
    assert set(re.findall(r"'sha256-([^']+)'", policy)) == hashes


@pytest.mark.parametrize("kind", ["content", "refused_content"])
def test_strings_of_users_stay_strings(kind: str, request: pytest.FixtureRequest) -> None:
    content: ReportContent = request.getfixturevalue(kind)
    names = (HOSTILE, *content.cameras[1:])
    snapshots = tuple(HOSTILE for _ in content.detections.snapshot_names)
    hostile = replace(
        content,
        title=HOSTILE,
        reason=HOSTILE,
        identity=HOSTILE,
        factory=replace(content.factory, camera_names=names),
        recalibrated=content.recalibrated and replace(content.recalibrated, camera_names=names),
        detections=replace(content.detections, camera_names=names, snapshot_names=snapshots),
        snapshots=tuple(SnapshotSummary(HOSTILE, 1, 0, HOSTILE) for _ in snapshots),
        seconds={HOSTILE: 1.0},
        command=HOSTILE,
        versions={HOSTILE: HOSTILE},
    )
    calm, page = Page(render(content)), Page(render(hostile))
    assert {tag for tag, _ in page.elements} == {tag for tag, _ in calm.elements}
    assert len(page.scripts) == 2
    assert page.text.count(HOSTILE) >= 10
    assert page.figures["rig-scene"]["names"][0] == HOSTILE


def test_one_of_the_two_scales_is_hidden(content: ReportContent) -> None:
    rule = ".scatter:has(#same-scale:checked) .own, .scatter:has(#same-scale:not(:checked)) .same { display: none; }"
    html = render(content)
    assert rule in html
    assert html.count('class="own"') == html.count('class="same"') == html.count('id="same-scale"') == 1


def test_same_content_gives_the_same_page(content: ReportContent) -> None:
    assert render(content) == render(replace(content))


def test_usual_page_is_small(content: ReportContent) -> None:
    assert len(render(content).encode()) < 1_600_000


def test_large_capture_is_thinned_and_says_so(large_content: ReportContent) -> None:
    html = render(large_content)
    assert len(html.encode()) < 3_000_000
    page = Page(html)
    assert "Drawings show a random or even selection" in page.text
    assert re.search(r"The rig shows 60 of \d+ poses and 50 of 400 fiducials in each", page.text)


def test_small_capture_is_drawn_in_full(content: ReportContent) -> None:
    assert "selection" not in Page(render(content)).text


def test_like_reasons_are_counted_together(content: ReportContent) -> None:
    reasons = ("no clear winner: margin 17.6", "no clear winner: margin 3.1", "", "", "", "blurred")
    snapshots = tuple(replace(s, reason=reason) for s, reason in zip(content.snapshots, reasons, strict=True))
    text = " ".join(Page(render(replace(content, snapshots=snapshots))).text.split())
    assert "rejected (3). 2 × no clear winner; 1 × blurred." in text
    assert "no clear winner: margin 3.1" in text


def test_frames_of_many_cameras_stay_within_the_size(content: ReportContent) -> None:
    noise = np.random.default_rng(0).integers(0, 256, (1088, 2048)).astype(np.uint8)
    uris = overlay.picture_uris((noise,) * 40)
    assert sum(len(uri) for uri in uris if uri) < 1.4 * overlay.LARGEST_FRAMES


def test_file_is_written_whole_or_not_at_all(plain_content: ReportContent, tmp_path: Path) -> None:
    path = tmp_path / "report.html"
    path.write_text("old")
    write_report(plain_content, path)
    assert path.read_text(encoding="utf-8") == render(plain_content)
    assert list(tmp_path.iterdir()) == [path]
    with pytest.raises(InputError, match="missing"):
        write_report(plain_content, tmp_path / "missing" / "report.html")


LOOK = """
  const header = page.querySelector(".bar-top").getBoundingClientRect();
  const canvas = page.querySelector("#scene");
  const pixels = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height).data;
  const mark = page.querySelector(".overlay use").getBoundingClientRect();
  const overlay = page.querySelector(".overlay");
  const whole = overlay.getAttribute("viewBox");
  overlay.dispatchEvent(new view.MouseEvent("click", {clientX: mark.x + 6, clientY: mark.y + 6}));
  await turn();
  const closer = page.querySelector(".overlay use").getBoundingClientRect();
  const links = (nav) => Math.max(...[...nav.children].map((link) => link.getBoundingClientRect().right)) -
    nav.getBoundingClientRect().right;
  const cells = [...page.querySelectorAll(".cameras td")].map((cell) => cell.scrollWidth - cell.clientWidth);
  return {
    header: header.height, nav: links(page.querySelector("nav")),
    sideways: page.documentElement.scrollWidth - view.innerWidth,
    drawn: pixels.filter((value, i) => i % 4 === 3 && value > 0).length, canvas: canvas.clientWidth,
    zoomed: overlay.getAttribute("viewBox") !== whole, mark: mark.width, closer: closer.width,
    spill: Math.max(...cells),
    stops: page.querySelectorAll("#overlays a, #overlays button, #overlays [tabindex]").length,
  };
"""


@pytest.mark.parametrize("width", [390, 1400])
def test_in_a_browser(browser: BrowserContext, content: ReportContent, width: int, tmp_path: Path) -> None:
    page = tmp_path / "report.html"
    write_report(content, page)
    found = measured(browser, page, width, LOOK)
    assert found["complaints"] == []
    assert found["header"] < (60 if width > 860 else 110)  # it stays on the screen of a wide window only
    assert found["nav"] <= 0  # no link is cut off
    assert found["sideways"] <= 0
    assert found["drawn"] > 2000 and found["canvas"] <= width
    assert found["zoomed"] and found["closer"] == pytest.approx(found["mark"], abs=1)
    assert found["mark"] == pytest.approx(12, abs=3)  # px on the screen, however large the frame
    assert found["spill"] <= 0
    assert found["stops"] == 0
