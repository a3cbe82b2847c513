"""What the pages get beyond MkDocs' plugins, so that they open from a folder, without a network or a server.

Equations become MathML, which browsers draw by themselves; the search finds its worker beside the pages; the trailing
comment of a field, where its shape and unit stand, becomes its description in the API. Drawings, which are images on
GitHub, become part of the page, and take its colours.
"""

import html
import re
from pathlib import Path
from typing import Any

from griffe import Attribute, Docstring, Extension
from latex2mathml.converter import convert
from mkdocs.utils import get_relative_url

MATH = re.compile(r'<(span|div) class="arithmatex">\\([(\[])(.*?)\\[)\]]</\1>', re.DOTALL)
NAMESPACE = re.compile(r' xmlns="[^"]*"')  # HTML knows what <math> is
SHIM = re.compile(r'<script src="[^"]*iframe-worker/shim"></script>')  # the theme would fetch it from the network
DRAWING = re.compile(r"!\[[^\]]*\]\((assets/\w+\.svg)\)")
STYLE = re.compile(r"<style>.*?</style>\n?", re.DOTALL)  # for the drawing as an image by itself
COMMENT = re.compile(r"\s#:?\s+(?!type:|noqa|fmt:)(.+)$")


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Put drawings into the page."""
    return DRAWING.sub(lambda found: STYLE.sub("", (Path(__file__).parent / found[1]).read_text()), markdown)


def on_page_content(content: str, **_: Any) -> str:
    """Turn every equation of a page into MathML."""
    return MATH.sub(_drawn, content)


def on_post_page(output: str, *, page: Any, **_: Any) -> str:
    """Let the search of a page start without a network."""
    return SHIM.sub(f'<script src="{get_relative_url("assets/search.js", page.url)}"></script>', output)


def on_post_template(output_content: str, **_: Any) -> str:
    """Do the same for pages without a source (404)."""
    return SHIM.sub("", output_content)


def _drawn(found: re.Match[str]) -> str:
    display = "block" if found[2] == "[" else "inline"
    drawn = NAMESPACE.sub("", convert(html.unescape(found[3]), display=display), count=1)
    return f'<div class="equation">{drawn}</div>' if display == "block" else drawn


class FieldComments(Extension):
    """Takes the comment at the end of a field's or a constant's line for its docstring, where it has none."""

    def on_attribute_instance(self, *, attr: Attribute, **_: Any) -> None:
        """Look at the lines of an attribute; the last comment counts."""
        if attr.docstring is not None or attr.lineno is None or attr.endlineno is None:
            return
        lines = attr.lines_collection[attr.filepath][attr.lineno - 1 : attr.endlineno]
        comments = [found[1] for line in lines if (found := COMMENT.search(line))]
        if comments:
            attr.docstring = Docstring(comments[-1], lineno=attr.lineno, parent=attr)
