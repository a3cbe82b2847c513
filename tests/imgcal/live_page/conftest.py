"""A page that is served, requests to it, and a browser where there is one."""

import shutil

import pytest

from imgcal.live_page.address import Address
from imgcal.live_page.live_page import LivePage
from tests.imgcal.live_page.pages import ACTIONS, Client, Stream, made_state

CHROMIUM = shutil.which("chromium")
ARGUMENTS = [
    "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run",
    "--disable-background-networking", "--disable-component-update", "--disable-sync",
]  # fmt: skip


@pytest.fixture(scope="module")
def served(o10, asymmetric8):
    """A page on O10 with one state."""
    with LivePage(o10, asymmetric8, Address(port=0), actions=ACTIONS) as page:
        page.publish(made_state(o10, asymmetric8))
        yield page


@pytest.fixture
def client(served):
    served.commands()
    return Client(served)


@pytest.fixture
def stream(served):
    reader = Stream(served)
    yield reader
    reader.close()


@pytest.fixture(scope="module")  # no longer than that: while it lives, this thread has a running loop
def browser(tmp_path_factory):
    """Headless Chromium; tests that need it are skipped, visibly, where there is none."""
    if CHROMIUM is None:
        pytest.skip("chromium is not installed: the live page is not tried in a browser")
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        context = playwright.chromium.launch_persistent_context(
            tmp_path_factory.mktemp("browser"), executable_path=CHROMIUM, args=ARGUMENTS
        )
        yield context
        context.close()
