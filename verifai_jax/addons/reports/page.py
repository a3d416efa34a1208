"""A page from its sections: one self-contained HTML file, usable with or without JavaScript.

    render(page)                                        # the text of the file
    write_page(page, "report.html")

Its content security policy allows only embedded pictures, and one style sheet and one script by
their hashes: nothing is loaded or sent, and no inserted text can run.
"""

import base64
import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from importlib import resources
from pathlib import Path
from typing import Any

from verifai_jax._version import __version__
from verifai_jax.addons.reports.markup import Markup, bullets, data_block, element, join
from verifai_jax.core.store.atomic_files import replacing


@dataclass(frozen=True)
class Section:
    """A part of a page: `anchor` for links, `title`, and `content`."""

    anchor: str
    title: str
    content: tuple[Markup, ...]


@dataclass(frozen=True)
class Page:
    """The parts of a report before it is rendered.

    - `headline`: the finding in a sentence, with `warnings` below it.
    - `tone`: the marking of the headline: `"fails"`, `"holds"` or `"open"`.
    - `claims`: the claims as plain data.
    - `view`: data of the interactive table; None without one.
    """

    title: str
    headline: str
    tone: str
    sections: tuple[Section, ...]
    claims: Mapping[str, Any]
    view: Mapping[str, Any] | None = field(default=None, repr=False)
    warnings: tuple[Markup, ...] = ()


def before_limits(page: Page, section: Section) -> Page:
    """Return a page with a section inserted before the one on its limits."""
    index = next(i for i, each in enumerate(page.sections) if each.anchor == "limits")
    return replace(page, sections=(*page.sections[:index], section, *page.sections[index:]))


def asset(name: str) -> str:
    """Return the text of a file next to this module."""
    return resources.files("verifai_jax.addons.reports").joinpath(name).read_text(encoding="utf-8")


def write_page(page: Page, path: str | Path) -> None:
    """Write a page as an HTML file, atomically."""
    with replacing(path) as partial:
        partial.write_text(render(page), encoding="utf-8", newline="\n")


def render(page: Page) -> str:
    """Convert a page to HTML."""
    style = asset("page.css") + asset("view.css")
    script = "" if page.view is None else asset("view.js") + asset("page.js")
    allowed = _source(script) if script else "'none'"
    policy = (
        f"default-src 'none'; img-src data:; style-src {_source(style)}; "
        f"script-src {allowed}; base-uri 'none'; form-action 'none'"
    )
    head = join(
        element("meta", charset="utf-8"),
        # Written by hand: its name has a hyphen and a capital.
        Markup(f'<meta http-equiv="Content-Security-Policy" content="{policy}">'),
        element("meta", name="viewport", content="width=device-width, initial-scale=1"),
        element("meta", name="generator", content=f"verifai_jax {__version__}"),
        element("title", page.title),
        Markup(f"<style>{style}</style>"),
    )
    links = bullets(element("a", each.title, href=f"#{each.anchor}") for each in page.sections)
    parts = [
        element("h1", page.title),
        element("p", page.headline, class_=f"headline {page.tone}"),
        *([element("div", page.warnings, class_="warning")] if page.warnings else []),
        element("nav", links, aria_label="sections"),
    ]
    parts += [
        element("section", element("h2", each.title), each.content, id=each.anchor)
        for each in page.sections
    ]
    blocks = [data_block("claims-json", page.claims)]
    if page.view is not None:
        blocks += [data_block("table-view", page.view), Markup(f"<script>{script}</script>")]
    body = join(element("main", parts), blocks)
    return f'<!doctype html>\n<html lang="en"><head>{head}</head>\n<body>{body}</body></html>\n'


def _source(text: str) -> str:
    """Return the hash by which the policy of a page allows a style sheet or a script."""
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"
