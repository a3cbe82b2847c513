"""A page that is served, and requests to it."""

import pytest

from imgcal.live_page import Address, LivePage
from tests.imgcal.live_page.pages import ACTIONS, Client, Stream, made_state


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
