"""The words of an expression."""

from __future__ import annotations

import re
from typing import NamedTuple, NoReturn

from latentplan.config import UserError

_MAX_TOKENS = 200
_TOKEN = re.compile(
    r"(?P<goal>goal:(?:\"[^\"]*\"|[^\s();]+))"
    r"|(?P<number>(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?)"
    r"|(?P<word>[A-Za-z_][A-Za-z_0-9]*(?:\.[A-Za-z_][A-Za-z_0-9]*)*)"
    r"|(?P<sign>->|[-+*<>()])"
)


class Token(NamedTuple):
    """A piece of text.

    Attributes:
        kind: `goal`, `number`, `word`, `sign` or `end`.
        text: What it says; empty at the end.
        position: Where it begins, counted from 0.
    """

    kind: str
    text: str
    position: int


def tokenize(text: str) -> list[Token]:
    """The tokens of a text, and an `end`.

    Raises:
        UserError: A character begins no token, or the text is very long.
    """
    tokens: list[Token] = []
    position = 0
    while position < len(text):
        if text[position].isspace():
            position += 1
            continue
        match = _TOKEN.match(text, position)
        if match is None:
            fail(text, position, f"{text[position]!r} means nothing here")
        if len(tokens) == _MAX_TOKENS:
            fail(text, position, f"an expression has at most {_MAX_TOKENS} numbers, names and signs")
        tokens.append(Token(str(match.lastgroup), match[0], position))
        position = match.end()
    return [*tokens, Token("end", "", len(text))]


def fail(text: str, position: int, reason: str) -> NoReturn:
    """Refuse an expression at a position.

    Raises:
        UserError: Always.
    """
    shown = text if len(text) <= 100 else text[:97] + "..."
    raise UserError(f"expression {shown!r}, position {position + 1}: {reason}")


def split_outside_quotes(text: str, separator: str) -> list[str]:
    """The parts of a text between separators, a single character; one within double quotes separates nothing."""
    return re.split(rf'{re.escape(separator)}(?=(?:[^"]*"[^"]*")*[^"]*$)', text)
