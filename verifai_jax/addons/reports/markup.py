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
        if child is None:
            continue
        if isinstance(child, Markup):
            parts.append(child)
        elif isinstance(child, str | int | float):
            parts.append(escape(child))
        else:
            parts.append(join(*child))
    return Markup("".join(parts))


def element(tag: str, *children: Child, **attributes: str | int | None) -> Markup:
    """Return an HTML element.

    **Arguments:**
    - `attributes`: attributes by name; `class_` is `class`, `aria_label` is `aria-label`, None is
      left out.
    """
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
    """Return a table that scrolls on its own on narrow pages.

    **Arguments:**
    - `heads`: the headings of the columns.
    - `rows`: their cells; the first cell is the heading of its row.
    - `caption`: the text above the table, if any.
    """
    body = [
        element("tr", element("th", first, scope="row"), [element("td", cell) for cell in others])
        for first, *others in rows
    ]
    return element(
        "div",
        element(
            "table",
            element("caption", caption) if caption else None,
            element("thead", element("tr", [element("th", head, scope="col") for head in heads])),
            element("tbody", body),
        ),
        class_="scroll",
        tabindex=0,
        role="region",
        aria_label=caption or ", ".join(heads),
    )


def picture(content: bytes, alternative: str, caption: str = "", kind: str = "png") -> Markup:
    """Return a figure with an embedded picture.

    **Arguments:**
    - `alternative`: text for readers who cannot see the picture.
    - `caption`: the text below it; by default the alternative text.
    - `kind`: `"png"` or `"gif"`.
    """
    data = base64.b64encode(content).decode()
    return element(
        "figure",
        element("img", src=f"data:image/{kind};base64,{data}", alt=alternative),
        element("figcaption", caption or alternative),
    )


def data_block(name: str, value: Mapping[str, Any] | Sequence[Any]) -> Markup:
    """Return plain data as an embedded JSON block that no text in the data can close.

    **Arguments:**
    - `name`: id of the block.
    - `value`: plain data without NaN and infinities.
    """
    text = json.dumps(value, allow_nan=False, separators=(",", ":"))
    for character in "<>&":
        text = text.replace(character, f"\\u{ord(character):04x}")
    return Markup(f'<script type="application/json" id="{escape(name)}">{text}</script>')
