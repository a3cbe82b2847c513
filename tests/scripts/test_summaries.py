"""The short pages and the README agree with the committed results."""

import pytest

from scripts.output import ROOT, replaced
from scripts.summaries import pages

PAGES = pages()


@pytest.mark.parametrize("name", PAGES)
def test_the_page_is_what_the_script_writes(name: str) -> None:
    page = ROOT / name
    text = page.read_text("utf-8")
    assert replaced(text, PAGES[name], page) == text, f"{name}: run `python -m scripts.summaries`"
    assert len(text.splitlines()) < 110
