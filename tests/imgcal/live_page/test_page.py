"""The page as text and in a real browser: content, buttons, and no injection."""

import base64
import contextlib
import hashlib
import json
import os
import re
import signal
import time
from dataclasses import replace

import pytest

from imgcal.io import read_rig
from imgcal.live_page import Address, Command, Demonstration, LivePage
from imgcal.live_page.page import live_page, report_page
from tests.imgcal.live_page.pages import ACTIONS, Client, alarm, dome, made_state

HOSTILE = '<img src=x onerror="window.hacked=1">'
RECORDS_LABELS = """
    window.labels = [];
    const {clearRect, fillText} = CanvasRenderingContext2D.prototype;
    CanvasRenderingContext2D.prototype.clearRect = function (...box) {
        window.labels = []; clearRect.apply(this, box);
    };
    CanvasRenderingContext2D.prototype.fillText = function (text, x, y) {
        window.labels.push([text, x, y, this.measureText(text).width]); fillText.call(this, text, x, y);
    };
"""


def test_the_policy_allows_this_script_and_this_style_and_no_other():
    page = live_page("O10 <live>", "secret-token")
    assert not re.search(r"<!--[A-Z]+-->", page.text) and "<title>O10 &lt;live&gt;</title>" in page.text
    for tag, kind in (("script", 'type="module"'), ("style", "")):
        (body,) = re.findall(rf"<{tag} ?{kind}>(.*?)</{tag}>", page.text, re.DOTALL)
        digest = base64.b64encode(hashlib.sha256(body.encode()).digest()).decode()
        assert f"{tag}-src 'sha256-{digest}'" in page.policy
    assert "connect-src 'self'" in page.policy and "connect-src 'none'" in report_page("O10", {}).policy
    assert "secret-token" in page.text and "innerHTML" not in page.text and "eval(" not in page.text


@contextlib.contextmanager
def opened(browser, url, width=1400, height=900, scheme="light"):
    """A tab that looks at a page and collects everything that goes wrong."""
    tab, wrong = browser.new_page(), []
    tab.on("console", lambda message: wrong.append(message.text) if message.type in ("error", "warning") else None)
    tab.on("pageerror", lambda error: wrong.append(str(error)))
    tab.set_default_timeout(10_000)
    tab.set_viewport_size({"width": width, "height": height})
    tab.emulate_media(color_scheme=scheme)
    tab.add_init_script(RECORDS_LABELS)
    tab.goto(url)
    tab.wrong = wrong
    try:
        yield tab
    finally:
        tab.close()


def says(tab, text, place="#sentence"):
    tab.wait_for_function(
        "([place, text]) => document.querySelector(place).textContent.includes(text)", arg=[place, text]
    )


def commands_of(page, count=1):
    found, end = [], time.monotonic() + 120
    while len(found) < count and time.monotonic() < end:
        found += page.commands()
        time.sleep(0.01)
    return found


@pytest.fixture
def calm(served, o10, asymmetric8):
    """The page after whatever an earlier test has left on it."""
    served.publish(made_state(o10, asymmetric8, 1))
    served.commands()
    return served


@pytest.fixture(scope="module")
def domed(asymmetric8):
    rig = dome(64)
    with LivePage(rig, asymmetric8, Address(port=0)) as page:
        page.publish(made_state(rig, asymmetric8, health={"cam09": "lost"}))
        yield page


@pytest.mark.parametrize(
    ("cameras", "width", "scheme"), [(10, 1400, "light"), (10, 390, "dark"), (64, 1400, "dark"), (64, 390, "light")]
)
def test_the_page_fits_and_reads_in_any_size(browser, request, cameras, width, scheme):
    page = request.getfixturevalue("served" if cameras == 10 else "domed")
    with opened(browser, page.url, width, scheme=scheme) as tab:
        says(tab, f"All {cameras} cameras as calibrated")
        tab.wait_for_function("() => document.querySelectorAll('#cameras .pick').length > 0 && labels.length > 0")
        assert tab.locator("#cameras .pick").count() == tab.locator("#frames figure").count() == cameras
        assert tab.evaluate("document.documentElement.scrollWidth <= innerWidth")
        box = tab.locator("#scene").bounding_box()
        labels = tab.evaluate("labels")
        assert len(labels) >= (10 if cameras == 10 else 12)
        if cameras == 64:  # what is not well comes before all others
            assert "09" in [text for text, *_ in labels]
        for i, (_, x, y, w) in enumerate(labels):
            assert x >= 0 and x + w <= box["width"] and 6 <= y <= box["height"] - 6
            for _, x2, y2, w2 in labels[:i]:
                assert x + w <= x2 or x2 + w2 <= x or abs(y - y2) >= 12
        dark = tab.evaluate("getComputedStyle(document.body).backgroundColor")
        assert (sum(map(int, re.findall(r"\d+", dark)[:3])) < 200) is (scheme == "dark")
        assert tab.wrong == []


def test_the_key_of_the_maps_says_from_where_to_where_each_colour_goes(browser, calm):
    with opened(browser, calm.url) as tab:
        tab.wait_for_function("() => document.querySelector('#maps-key span') !== null", timeout=120_000)
        first, *between, last, _ = tab.locator("#maps-key span").all_inner_texts()
    assert re.fullmatch(r"below [\d.]+ mm", first) and re.fullmatch(r"above [\d.]+", last)
    assert between and all(re.fullmatch(r"[\d.]+–[\d.]+", words) for words in between)


def test_a_camera_that_moved_is_on_the_page_soon(browser, calm, o10, asymmetric8):
    with opened(browser, calm.url) as tab:
        says(tab, "as calibrated")
        tab.wait_for_function("() => document.querySelectorAll('#cameras .pick').length === 10")
        words = "() => document.querySelectorAll('#cameras tbody tr')[6].textContent.includes('recalibrating')"
        moved = {"health": {"cam07": "relearning"}, "sentence": "cam07 turned 0.3 degrees", "events": (alarm("cam07"),)}
        begun = time.monotonic()
        calm.publish(made_state(o10, asymmetric8, 2, **moved))
        says(tab, "cam07 turned 0.3 degrees")
        assert time.monotonic() - begun < 5.0
        tab.wait_for_function(words)
        says(tab, "cam07 turned 0.3 degrees", "#alarm-text")
        calm.commands()
        tab.click("#acknowledge")
        tab.wait_for_selector("#alarm", state="hidden")
        assert commands_of(calm)[0].name == "acknowledge"
        calm.publish(made_state(o10, asymmetric8, 3))
        says(tab, "All 10 cameras as calibrated")
        assert tab.wrong == []


def test_without_the_object_the_page_says_so(browser, calm, o10, asymmetric8):
    """And not what the identification could not do; a single snapshot without it is no news."""
    seen = made_state(o10, asymmetric8, 2, now=1.7e9)
    blobs = seen.detections.select(seen.detections.fiducial < 1)
    refused = "identity: too few blobs: at most 1 in a camera, expected at least 4 in one"
    without = replace(seen, detections=blobs, rig_from_object=None, refused=refused)
    with opened(browser, calm.url) as tab:
        calm.publish(replace(without, snapshot=3, time=1.7e9 + 0.1))
        says(tab, "No object in view", "#detail")
        says(tab, "All 10 cameras as calibrated")
        calm.publish(replace(without, snapshot=4, time=1.7e9 + 2.0))
        says(tab, "No object in view.")
        assert "identity" not in tab.inner_text("#state") and "All 10 cameras" in tab.inner_text("#detail")
        calm.publish(replace(seen, snapshot=5, time=1.7e9 + 3.0))
        says(tab, "All 10 cameras as calibrated")
        says(tab, "10 of 10 cameras see the object", "#detail")
        assert tab.wrong == []


def test_an_alarm_that_is_over_is_in_the_past_tense(browser, o10, asymmetric8):
    lost = replace(alarm("cam02", message="cam02 does not see the object", since=5.0), kind="camera_lost")
    back = replace(alarm("cam02", message="cam02 sees the object again", since=5.0), kind="camera_back")
    with LivePage(o10, asymmetric8, Address(port=0)) as page, opened(browser, page.url) as tab:
        page.publish(made_state(o10, asymmetric8, 1, health={"cam02": "lost"}, events=(lost,)))
        says(tab, "cam02 does not see the object", "#alarm-text")
        page.publish(made_state(o10, asymmetric8, 2, events=(back,)))
        says(tab, "cam02 saw the object again", "#events")
        says(tab, "cam02 lost the object", "#events")
        tab.wait_for_selector("#alarm", state="hidden")
        assert "does not" not in tab.inner_text("#events")
        assert tab.wrong == []


def test_how_well_a_camera_is_known_again_is_no_value(browser, o10, asymmetric8):
    event = alarm("cam03", message="cam03 turned 0.3 +- 0.01 deg; known again to +- 0.013 deg", since=5.0)
    with LivePage(o10, asymmetric8, Address(port=0)) as page, opened(browser, page.url) as tab:
        page.publish(made_state(o10, asymmetric8, 1, events=(replace(event, kind="relearnt", sigma=0.013),)))
        says(tab, "known again to ±0.013 deg", "#events")
        assert "known again to +- 0.013" not in tab.inner_text("body")
        assert tab.wrong == []


def test_buttons_command_and_the_factory_asks_first(browser, calm):
    calm.commands()
    with opened(browser, calm.url) as tab:
        says(tab, "as calibrated")
        tab.select_option("#action-camera", "3")
        tab.click("[data-action=bump]")
        assert commands_of(calm) == [Command("bump", "cam04")]
        says(tab, "cam04", "#camera-title")
        tab.click("[data-action=warm]")
        says(tab, "Cool down", "[data-action=warm]")
        tab.click("#pause")
        says(tab, "Paused")
        tab.click("#pause")
        says(tab, "as calibrated")
        assert commands_of(calm, 3) == [Command("warm"), Command("pause"), Command("resume")]
        tab.click("#factory")
        tab.keyboard.press("Escape")
        tab.click("#factory")
        tab.click("#confirm-no")
        time.sleep(0.3)
        assert calm.commands() == []
        tab.click("#factory")
        tab.click("#confirm-yes")
        assert commands_of(calm) == [Command("factory")]
        assert tab.wrong == []


def test_keys_do_what_a_mouse_does_and_the_wheel_scrolls(browser, calm):
    with opened(browser, calm.url) as tab:
        says(tab, "as calibrated")
        tab.wait_for_function("() => labels.length > 5")
        before = tab.evaluate("labels")
        tab.focus("#scene")
        tab.keyboard.press("ArrowLeft")
        tab.wait_for_function("before => JSON.stringify(labels) !== JSON.stringify(before)", arg=before)
        assert tab.get_attribute("[data-view=rest]", "aria-pressed") == "false"
        tab.keyboard.press("Home")
        assert tab.get_attribute("[data-view=rest]", "aria-pressed") == "true"
        tab.focus("#cameras tbody tr:nth-child(5) .pick")
        tab.keyboard.press("Enter")
        says(tab, "cam05", "#camera-title")
        tab.hover("#scene")
        tab.mouse.wheel(0, 300)
        tab.wait_for_function("() => scrollY > 200")
        names = tab.evaluate(
            "[...document.querySelectorAll('button,a,select,canvas,svg[role=img]')].filter(e => e.checkVisibility() && "
            "!(e.getAttribute('aria-label') || e.textContent.trim() || e.labels?.length)).map(e => e.outerHTML)"
        )
        assert names == []  # everything that can be used has a name that can be read out
        assert "10 calibrated" in tab.get_attribute("#scene", "aria-label")
        assert tab.get_attribute("#sentence", "aria-live") == "polite"
        assert tab.wrong == []


def test_names_and_messages_are_text(browser, o10, asymmetric8):
    rig = replace(o10, camera_names=tuple(HOSTILE + str(i) for i in range(10)))
    with LivePage(rig, asymmetric8, Address(port=0), actions=ACTIONS, title=HOSTILE) as page:
        message = f"{HOSTILE}</script><script>window.hacked=1</script>"
        state = made_state(rig, asymmetric8, events=(alarm(rig.camera_names[2], message=message),), sentence=message)
        page.publish(state)
        with opened(browser, page.url) as tab:
            says(tab, "</script><script>")
            says(tab, HOSTILE, "#cameras")
            says(tab, HOSTILE, "#events")
            assert tab.evaluate("window.hacked") is None and tab.locator("img[src=x]").count() == 0
            tab.goto("about:blank")
            report = Client(page)("GET", "/report.html")[2]
            tab.set_content(report)
            assert tab.evaluate("window.hacked") is None and tab.locator("img[src=x]").count() == 0


def test_a_report_opens_without_a_server(browser, calm, tmp_path):
    for _ in range(40):
        status, _, text = Client(calm)("GET", "/report.html")
        if status == 200:
            break
        time.sleep(0.2)
    (tmp_path / "report.html").write_text(text)
    asked = []
    with opened(browser, "about:blank") as tab:
        tab.on("request", lambda request: asked.append(request.url))
        tab.goto((tmp_path / "report.html").as_uri())
        says(tab, "cameras as calibrated")
        says(tab, "as of", "#link")
        assert tab.locator("#pause").is_hidden() and tab.locator("#actions").is_hidden()
        assert tab.wrong == [] and [url for url in asked if not url.startswith(("file:", "data:"))] == []


def test_a_bump_at_the_press_of_a_button_is_told_with_its_camera(browser, asymmetric8):
    """The whole chain: button, server, loop, simulated rig, keeper, server, page."""
    with Demonstration(read_rig("T4"), asymmetric8, Address(port=0), seed=1) as shown:
        seconds = (number / 15 for number in range(10**6))

        def runs_until(done):
            ends = time.monotonic() + 300
            while not done():
                assert time.monotonic() < ends
                shown.step(next(seconds))

        begun = [shown.step(next(seconds)).sentence for _ in range(20)]
        assert begun[-1] == "all 4 cameras are calibrated"
        with opened(browser, shown.page.url) as tab:
            tab.set_default_timeout(120_000)
            says(tab, "All 4 cameras are calibrated")
            assert tab.locator("#alarm").is_hidden()
            before = shown.simulated.rig
            tab.select_option("#action-camera", "2")
            tab.click("[data-action=bump]")
            runs_until(lambda: shown.simulated.rig.local(before).abs().amax() > 1e-3)
            runs_until(lambda: "cam03" in tab.inner_text("#alarm-text"))
            says(tab, "cam03", "#events")
            assert all(name not in tab.inner_text("#events") for name in ("cam01", "cam02", "cam04"))
            assert tab.wrong == []


def test_the_page_comes_back_after_the_server(browser, calm, o10, asymmetric8):
    with opened(browser, calm.url) as tab:
        says(tab, "as calibrated")
        os.kill(calm._server.pid, signal.SIGKILL)
        says(tab, "connection lost", "#link")
        end = time.monotonic() + 90
        while time.monotonic() < end and "live" not in tab.inner_text("#link"):
            calm.publish(made_state(o10, asymmetric8, 50, sentence="here again"))
            time.sleep(0.2)
        says(tab, "Here again")
        calm.commands()
        tab.click("#pause")
        assert json.dumps([command.name for command in commands_of(calm)]) == '["pause"]'
