"""Parser of objectives and constraints: from text to expressions, with errors that name the position in the text.

The grammar, which `_Parser` reads by recursive descent, one method per rule:

    conjunction:  comparison { "and" comparison }
    comparison:   sum [ ("<" | ">" | "->") sum ]
    sum:          product { ("+" | "-") product }
    product:      factor { "*" factor }
    factor:       "-" factor | NUMBER | NAME | "task" "(" NAME ")" | "abs" "(" sum ")" | "(" conjunction ")"
                  | "return" | "goal:FILE"

The parser is written by hand, because a parser library could not replace most of its lines (checks and error messages),
and would take longer to import than a text takes to parse.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping
from typing import NamedTuple, NoReturn

from latentplan.config import UserError
from latentplan.config.checks import nearest, shown
from latentplan.config.quantities import TASK_PREFIX
from latentplan.objectives.expression import (
    Absolute,
    And,
    Arithmetic,
    Clause,
    Expression,
    GoalImage,
    LearnedReturn,
    Name,
    Node,
    Number,
    Phase,
    combine,
    walk,
)

_TOKEN = re.compile(
    r"(?P<goal>goal:(?:\"[^\"]*\"|[^\s();\"]+))"
    r"|(?P<number>(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?)"
    r"|(?P<word>[A-Za-z_][A-Za-z_0-9]*(?:\.[A-Za-z_][A-Za-z_0-9]*)*)"
    r"|(?P<sign>->|[-+*<>()])"
)
_RELATIONS = ("<", ">", "->")
_MAX_TOKENS = 200
_MAX_DEPTH = 50
_MAX_SHOWN = 60  # characters of a text in an error message
_MAX_LENGTH = 10_000  # characters of a text; far more than 200 tokens need
_SWITCH = re.compile(r"(?P<frame>[0-9]{1,15})\s*:")


def parse_schedule(text: str, scales: Mapping[str, float]) -> tuple[Phase, ...]:
    """Parses objectives with the env frames at which they begin, such as `height > 1.2; 500: speed -> 1.0`.

    Args:
        text: Objectives separated by `;`; each, except the first, begins with its first env frame. Blank parts are
            skipped.
        scales: Scale of every quantity that an objective may name.

    Raises:
        UserError: The text is no schedule; the message names the position and the nearest name.
    """
    _check_length(text)
    text = text.strip()
    phases: list[Phase] = []
    for start, end in list(_find_parts(text)) or [(0, len(text))]:
        match = _SWITCH.match(text, start, end)
        if phases and match is None:
            raise UserError(
                f"{shown(text[start:end])} needs the env frame from which it holds, as in '; 500: speed -> 1.0'"
            )
        frame = 0 if match is None else int(match["frame"])
        if frame <= phases[-1].start if phases else frame > 0:
            raise UserError(f"env frames of {shown(text)} must begin with 0 (which may be left out) and increase")
        first = start if match is None else match.end()
        phases.append(Phase(frame, _Parser(text, scales, first, end).read_expression()))
    return tuple(phases)


def parse_objective(text: str, scales: Mapping[str, float]) -> Expression:
    """Parses an objective: a weighted sum of clauses, clauses joined by `and`, quantities, `return` and goal images.

    Raises:
        UserError: The text is no objective; the message names the position and the nearest name.
    """
    _check_length(text)
    text = text.strip()
    return _Parser(text, scales, 0, len(text)).read_expression()


def parse_reward(text: str, scales: Mapping[str, float], setting: str) -> Expression:
    """Parses a reward: an objective of quantities and tasks, without `return` and goal images.

    Raises:
        UserError: The text is no reward; the message names the setting.
    """
    expression = parse_objective(text, scales)
    if any(isinstance(term, LearnedReturn | GoalImage) for _, term in expression.terms):
        raise UserError(f"{setting} {shown(text)} must consist of named quantities and tasks only")
    return expression


def parse_constraints(text: str, scales: Mapping[str, float]) -> tuple[Clause, ...]:
    """Parses inequalities that must hold at every env frame, separated by `;` or joined by `and`.

    Blank parts are skipped, so that blank text gives no clauses.

    Raises:
        UserError: The text is no constraint; the message names the position and the nearest name.
    """
    _check_length(text)
    text = text.strip()
    parsers = [_Parser(text, scales, start, end) for start, end in _find_parts(text)]
    return tuple(clause for parser in parsers for clause in parser.read_inequalities())


def split_outside_quotes(text: str, separator: str) -> list[str]:
    """Parts of a text between separators (one character each); separators within double quotes are ignored."""
    return re.split(rf'{re.escape(separator)}(?=(?:[^"]*"[^"]*")*[^"]*$)', text)


def _find_parts(text: str) -> Iterator[tuple[int, int]]:
    """Yields start and end of each part between `;` that is not blank, without the blanks around the part."""
    position = 0
    for part in split_outside_quotes(text, ";"):
        if part.strip():
            start = position + len(part) - len(part.lstrip())
            yield start, start + len(part.strip())
        position += len(part) + 1


class _Token(NamedTuple):
    """A token of the text.

    Attributes:
        kind: `goal`, `number`, `word`, `sign` or `end`.
        text: The characters of the token; empty at the end.
        position: Index of the first character in the whole text.
    """

    kind: str
    text: str
    position: int

    @property
    def shown(self) -> str:
        """The token for an error message."""
        return _shorten(self.text) or "the end"


class _Parser:
    """Reads the part of a text from `start` up to `end`; errors name positions in the whole text.

    `positions` maps the identity of each node to the index of the node's first character.
    """

    def __init__(self, text: str, scales: Mapping[str, float], start: int, end: int) -> None:
        self.text, self.scales = text, scales
        self.start, self.end = start, end
        self.tokens = self._tokenize()
        self.index = self.depth = 0
        self.positions: dict[int, int] = {}

    def parse(self) -> Node:
        """The part as one node."""
        node = self._conjunction()
        if self._next.kind != "end":
            self._fail(self._next, f"expected an operator or the end, got {self._next.shown!r}")
        return node

    def read_expression(self) -> Expression:
        """The part as an objective."""
        written = self.text[self.start : self.end].strip()
        return Expression(written, tuple(self.split_sum(self.parse(), 1.0)))

    def split_sum(self, node: Node, weight: float) -> list[tuple[float, Node]]:
        """Weight and node of each term of a sum; only a whole term may be the learned return or a goal image."""
        match node:
            case Arithmetic("+" | "-" as sign, left, right):
                factor = weight if sign == "+" else -weight
                return self.split_sum(left, weight) + self.split_sum(right, factor)
            case Arithmetic("*", Number(value), other) | Arithmetic("*", other, Number(value)):
                if not math.isfinite(weight * value):
                    self._fail(node, "this weight is too large for a number")
                return self.split_sum(other, weight * value)
        if not isinstance(node, LearnedReturn | GoalImage):
            self._forbid_whole_terms(node)
        return [(weight, node)]

    def read_inequalities(self) -> list[Clause]:
        """The clauses of a constraint."""
        found: list[Clause] = []
        pending = [self.parse()]
        while pending:
            node = pending.pop(0)
            if isinstance(node, And):
                pending[:0] = [node.left, node.right]
            elif isinstance(node, Clause) and node.relation != "->":
                found.append(node)
            else:
                self._fail(node, "a constraint is an inequality such as 'cart < 0.5', or inequalities joined by 'and'")
        return found

    def _tokenize(self) -> list[_Token]:
        """The tokens of the text, and an `end`."""
        tokens: list[_Token] = []
        position = self.start
        while position < self.end:
            if self.text[position].isspace():
                position += 1
                continue
            match = _TOKEN.match(self.text, position, self.end)
            token = _Token(str(match and match.lastgroup), match[0] if match else self.text[position], position)
            if match is None:
                is_goal = token.text == ":" and tokens and tokens[-1].text == "goal"
                reason = 'write goal:FILE or goal:"FILE"' if is_goal else f"unexpected {token.text!r}"
                self._fail(token, f"{reason}; clauses compare by <, > and ->" if token.text == "=" else reason)
            if len(tokens) == _MAX_TOKENS:
                self._fail(token, f"an expression has at most {_MAX_TOKENS} numbers, names and signs")
            tokens.append(token)
            position = match.end()
        return [*tokens, _Token("end", "", self.end)]

    def _conjunction(self) -> Node:
        node = self._comparison()
        while self._next.text == "and":
            sign = self._take()
            right = self._comparison()
            for side in (node, right):
                if not _is_degree(side):
                    self._fail(sign, "'and' joins clauses such as height > 1.2; write weights around parentheses")
            node = self._set_position(And(node, right), node)
        return node

    def _comparison(self) -> Node:
        first = self._next
        left = self._sum()
        if self._next.text not in _RELATIONS:
            return left
        relation = self._take()
        right = self._sum()
        if self._next.text in _RELATIONS:
            self._fail(self._next, "a comparison has two sides; join two comparisons with 'and'")
        for side in (left, right):
            self._check_side(relation, side)
        margin = self._scale(left) + self._scale(right)
        if margin == 0.0:
            self._fail(relation, "a comparison needs a quantity on one side at least")
        end = self.tokens[self.index - 1]
        written = self.text[first.position : end.position + len(end.text)]
        return self._set_position(Clause(relation.text, left, right, margin, written), left)

    def _sum(self) -> Node:
        node = self._product()
        while self._next.text in ("+", "-"):
            sign = self._take()
            node = self._set_position(self._combine(sign, node, self._product()), node)
        return node

    def _product(self) -> Node:
        node = self._factor()
        while self._next.text == "*":
            sign = self._take()
            node = self._set_position(self._combine(sign, node, self._factor()), node)
        return node

    def _factor(self) -> Node:
        self.depth += 1
        if self.depth > _MAX_DEPTH:
            self._fail(self._next, f"more than {_MAX_DEPTH} levels of parentheses and signs")
        token = self._take()
        node = self._read(token)
        self.positions[id(node)] = token.position
        self.depth -= 1
        return node

    def _read(self, token: _Token) -> Node:
        match token:
            case _Token("number", text):
                if not math.isfinite(float(text)):
                    self._fail(token, f"{token.shown} is too large for a number")
                return Number(float(text))
            case _Token("goal", text):
                return GoalImage(text.removeprefix("goal:").strip('"'))
            case _Token("sign", "-"):
                return self._combine(token._replace(text="*"), Number(-1.0), self._factor())
            case _Token("sign", "("):
                node = self._conjunction()
                self._expect(")", "an operator or ')'")
                return node
            case _Token("word", "abs"):
                self._expect("(")
                inner = self._sum()
                if self._next.text in _RELATIONS:
                    self._fail(self._next, "abs() takes a quantity, not a comparison")
                self._expect(")", "an operator or ')'")
                return Absolute(inner)
            case _Token("word", "task"):
                self._expect("(")
                task = self._take()
                if task.kind != "word":
                    self._fail(task, f"expected the name of a task, got {task.shown!r}")
                self._expect(")")
                return self._quantity(task, TASK_PREFIX + task.text)
            case _Token("word", "return"):
                return LearnedReturn()
            case _Token("word", text) if text != "and":
                return self._quantity(token, text)
        self._fail(token, f"expected a quantity, a number or '(', got {token.shown!r}")

    def _quantity(self, token: _Token, name: str) -> Name:
        if name in self.scales:
            return Name(name)
        name = _shorten(name)
        if self._next.text == "(":
            self._fail(token, f"unknown function {name!r}; available: abs(QUANTITY), task(NAME)")
        if not self.scales:
            self._fail(token, f"unknown quantity {name!r}: this body has no named quantities")
        similar = nearest(name, self.scales, cutoff=0.0)
        available = ", ".join(self.scales)
        self._fail(token, f"unknown quantity {shown(name)}; available: {available}. Did you mean {similar!r}?")

    def _combine(self, sign: _Token, left: Node, right: Node) -> Node:
        node = combine(sign.text, left, right)
        if isinstance(node, Number) and not math.isfinite(node.value):
            self._fail(sign, "this product or sum is too large for a number")
        return node

    def _check_side(self, relation: _Token, side: Node) -> None:
        parts = list(walk(side))
        self._forbid_whole_terms(side)
        if any(isinstance(part, Clause | And) for part in parts):
            self._fail(relation, "a side of a comparison is a quantity, not a clause")
        kinds = {part.name.startswith(TASK_PREFIX) for part in parts if isinstance(part, Name)}
        if len(kinds) > 1:
            self._fail(relation, "this compares a sum of rewards and quantities; put the clause in parentheses")

    def _forbid_whole_terms(self, node: Node) -> None:
        for part in walk(node):
            if isinstance(part, LearnedReturn | GoalImage):
                name = "return" if isinstance(part, LearnedReturn) else "a goal image"
                self._fail(part, f"{name} can only be weighted and added")

    def _scale(self, node: Node) -> float:
        """The scale of one side of a clause, as defined at the top of `latentplan.objectives.expression`."""
        match node:
            case Name(name):
                return self.scales[name]
            case Absolute(inner):
                return self._scale(inner)
            case Arithmetic("*", Number(value), other) | Arithmetic("*", other, Number(value)):
                return abs(value) * self._scale(other)
            case Arithmetic("*", left, right):
                return self._scale(left) * self._scale(right)
            case Arithmetic(_, left, right):
                return self._scale(left) + self._scale(right)
        return 0.0

    @property
    def _next(self) -> _Token:
        return self.tokens[self.index]

    def _take(self) -> _Token:
        token = self.tokens[self.index]
        self.index = min(self.index + 1, len(self.tokens) - 1)
        return token

    def _expect(self, sign: str, wanted: str | None = None) -> None:
        token = self._take()
        if token.text != sign:
            self._fail(token, f"expected {wanted or repr(sign)}, got {token.shown!r}")

    def _set_position(self, node: Node, first: Node) -> Node:
        """The node; records that the node begins at the position of its first part."""
        self.positions[id(node)] = self.positions[id(first)]
        return node

    def _fail(self, place: _Token | Node, reason: str) -> NoReturn:
        position = place.position if isinstance(place, _Token) else self.positions[id(place)]
        raise UserError(f"expression {_shorten(self.text)!r}, position {position + 1}: {reason}")


def _is_degree(node: Node) -> bool:
    """Whether the value of a node is a degree in [0, 1]: a clause, clauses joined by `and`, or the reward of a task."""
    is_reward = isinstance(node, Name) and node.name.startswith(TASK_PREFIX)
    return is_reward or isinstance(node, Clause | And)


def _check_length(text: str) -> None:
    if len(text) > _MAX_LENGTH:
        raise UserError(f"an expression has at most {_MAX_LENGTH:,} characters, got {len(text):,}")


def _shorten(text: str) -> str:
    return text if len(text) <= _MAX_SHOWN else text[: _MAX_SHOWN - 3] + "..."
