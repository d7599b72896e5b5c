"""Self-contained web pages: sections with figures, tables, pictures and films, and no address of another file."""

from __future__ import annotations

import base64
import re
import string
from collections.abc import Iterable, Sequence
from html import escape
from pathlib import Path
from typing import NamedTuple

import cv2

from latentplan.reporting.frame import Frame

LARGEST_FILM = 6_000_000
WIDEST_CARD = 48  # characters of a row in a card of one column
MEDIA = {".webm": "video/webm", ".mp4": "video/mp4"}
_FOLDER = Path(__file__).parent
_NUMBER = re.compile(r"[-+]?[\d,.]+( ms| %)?|-")


class Section(NamedTuple):
    """A section of a page.

    Attributes:
        name: Heading.
        intro: Text below the heading.
        parts: Elements in a grid, as HTML.
    """

    name: str
    intro: str
    parts: Sequence[str]


def render_page(title: str, sections: Iterable[Section]) -> str:
    """The page as HTML; sections without elements are left out.

    Characters that UTF-8 cannot encode, as in names of files that are not UTF-8, become escapes.

    Args:
        title: Title and heading.
        sections: The sections, in order.
    """
    links, bodies = [], []
    for section in sections:
        if section.parts:
            anchor = re.sub(r"\W+", "-", section.name.lower()).strip("-")
            links.append(f'<a href="#{anchor}">{escape(section.name)}</a>')
            grid = "\n".join(section.parts)
            bodies.append(
                f'<section id="{anchor}"><h2>{escape(section.name)}</h2><p>{escape(section.intro)}</p>'
                f'<div class="grid">{grid}</div></section>'
            )
    template = string.Template(read_part("page.html"))
    parts = {"style": read_part("page.css"), "theme": read_part("theme.js")}
    page = template.substitute(title=escape(title), links="\n".join(links), body="\n".join(bodies), **parts)
    return page.encode("utf-8", "backslashreplace").decode("utf-8")


def read_part(name: str) -> str:
    """The text of a file that pages are made of: `page.html`, `page.css` (the look) or `theme.js` (light and dark)."""
    return (_FOLDER / name).read_text(encoding="utf-8")


def figure(content: str, caption: str) -> str:
    """A drawing, picture or film with its caption."""
    return f"<figure>{content}<figcaption>{escape(caption)}</figcaption></figure>"


def table(rows: Sequence[Sequence[str]], caption: str = "") -> str:
    """A table; the first row is its header, and columns of numbers are aligned to the right."""
    head, *body = rows
    is_number = [bool(body) and all(_NUMBER.fullmatch(row[column]) for row in body) for column in range(len(head))]

    def cells(row: Sequence[str], tag: str) -> str:
        kinds = [' class="number"' if number else "" for number in is_number]
        return "".join(f"<{tag}{kind}>{escape(cell)}</{tag}>" for cell, kind in zip(row, kinds, strict=True))

    lines = "".join(f"<tr>{cells(row, 'td')}</tr>" for row in body)
    longest = [max(len(row[column]) for row in rows) for column in range(len(head))]
    wide = " wide" if sum(longest) > WIDEST_CARD else ""
    title = f"<caption>{escape(caption)}</caption>" if caption else ""
    return (
        f'<div class="card scroll{wide}" tabindex="0"><table>{title}<thead><tr>{cells(head, "th")}</tr></thead>'
        f"<tbody>{lines}</tbody></table></div>"
    )


def picture(frame: Frame, alt: str) -> str:
    """A picture, RGB uint8 (height, width, 3), as PNG whose pixels stay sharp when it is enlarged."""
    return f'<img class="pixels" alt="{escape(alt)}" src="{data_address(encode_png(frame))}">'


def encode_png(frame: Frame) -> bytes:
    """A picture, RGB uint8 (height, width, 3), as the content of a PNG file."""
    _, png = cv2.imencode(".png", cv2.cvtColor(frame, cv2.COLOR_RGB2BGR))
    return bytes(png.tobytes())


def data_address(png: bytes) -> str:
    """The content of a PNG file as an address that an `img` shows."""
    return f"data:image/png;base64,{base64.b64encode(png).decode()}"


def film(path: Path, name: str, largest: int = LARGEST_FILM) -> str:
    """A film as an element with controls; a sentence where there is no film, or where it is too large for the page.

    Args:
        path: The film, `.mp4` or `.webm`.
        name: What the film shows.
        largest: Size of the largest film that the page may hold, in bytes.
    """
    if not path.exists():
        return f"<p>There is no film at {escape(path.name)}.</p>"
    if path.stat().st_size > largest:
        size = path.stat().st_size / 1e6
        return f"<p>The film {escape(path.name)} has {size:.1f} MB and is too large for this page.</p>"
    data = base64.b64encode(path.read_bytes()).decode()
    return (
        f'<video controls loop muted playsinline preload="metadata" aria-label="{escape(name)}" '
        f'src="data:{MEDIA[path.suffix]};base64,{data}"></video>'
    )


def scrubber(name: str, frames: Sequence[tuple[str, str]]) -> str:
    """Elements of which a slider shows one at a time, the last one first; without scripts all are shown.

    Args:
        name: What the slider chooses, such as `iteration`.
        frames: Name and HTML of each element.
    """
    inner = "".join(f'<div class="frame" data-name="{escape(label)}">{content}</div>' for label, content in frames)
    return f'<div class="scrub" data-name="{escape(name)}">{inner}</div>'
