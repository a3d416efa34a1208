"""HTML as nested elements, in which every text is escaped.

    str(element("p", "less than ", element("b", "<script>")))
    # <p>less than <b>&lt;script&gt;</b></p>

Texts are untrusted: names of features, messages of systems, notes. Only a `Markup` is HTML; any
other text is escaped when it is inserted.
"""

import base64
import html
import json
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, TypeAlias

from verifai_jax.core.messages.text import printable

VOID = frozenset({"br", "hr", "img", "meta", "input"})
"""Elements without content and without an end tag."""


class Markup(str):
    """A text that is already HTML."""


Child: TypeAlias = "str | int | float | Iterable[Child] | None"
"""Content of an element: text, markup, nothing, or several of them."""


def escape(text: object) -> Markup:
    """Return a text as HTML that displays it, with control characters as escapes."""
    return Markup(html.escape(printable(str(text))))


def join(*children: Child) -> Markup:
    """Return the HTML of several children, concatenated."""
    parts = []
    for child in children:
        if isinstance(child, Markup):
            parts.append(child)
        elif isinstance(child, str | int | float):
            parts.append(escape(child))
        elif child is not None:
            parts.append(join(*child))
    return Markup("".join(parts))


def element(tag: str, *children: Child, **attributes: str | int | None) -> Markup:
    """Return an HTML element; `class_` is `class`, `aria_label` is `aria-label`, None left out."""
    words = [
        f' {name.rstrip("_").replace("_", "-")}="{escape(value)}"'
        for name, value in attributes.items()
        if value is not None
    ]
    start = f"<{tag}{''.join(words)}>"
    return Markup(start if tag in VOID else f"{start}{join(*children)}</{tag}>")


def paragraph(*children: Child) -> Markup:
    """Return a paragraph."""
    return element("p", *children)


def bullets(items: Iterable[Child]) -> Markup:
    """Return a list of items."""
    return element("ul", [element("li", item) for item in items])


def preformatted(text: str) -> Markup:
    """Return preformatted lines of text, such as a command."""
    return element("pre", element("code", text))


def table(heads: Sequence[str], rows: Iterable[Sequence[Child]], caption: str = "") -> Markup:
    """Return a table that scrolls on narrow pages; the first cell of a row is its heading."""
    body = [
        element("tr", element("th", first, scope="row"), [element("td", cell) for cell in others])
        for first, *others in rows
    ]
    head = element("thead", element("tr", [element("th", head, scope="col") for head in heads]))
    above = element("caption", caption) if caption else None
    whole, name = element("table", above, head, element("tbody", body)), caption or ", ".join(heads)
    return element("div", whole, class_="scroll", tabindex=0, role="region", aria_label=name)


def picture(content: bytes, alternative: str, caption: str = "", kind: str = "png") -> Markup:
    """Return a figure with an embedded PNG or GIF, and a text for those who cannot see it."""
    data = f"data:image/{kind};base64,{base64.b64encode(content).decode()}"
    image = element("img", src=data, alt=alternative)
    return element("figure", image, element("figcaption", caption or alternative))


def data_block(name: str, value: Mapping[str, Any] | Sequence[Any]) -> Markup:
    """Return plain data, all finite, as an embedded JSON block that no text in it can close."""
    text = json.dumps(value, allow_nan=False, separators=(",", ":"))
    for character in "<>&":
        text = text.replace(character, f"\\u{ord(character):04x}")
    return Markup(f'<script type="application/json" id="{escape(name)}">{text}</script>')
