"""From text to expressions, with errors that say where and what.

conjunction:  comparison { "and" comparison }
comparison:   sum [ ("<" | ">" | "->") sum ]
sum:          product { ("+" | "-") product }
product:      factor { "*" factor }
factor:       "-" factor | NUMBER | NAME | "task" "(" NAME ")" | "abs" "(" sum ")" | "(" conjunction ")"
              | "return" | "goal:FILE"
"""

from __future__ import annotations

import difflib
import math
import re
from collections.abc import Mapping
from typing import NoReturn

from latentplan.config import UserError
from latentplan.config.quantities import TASK_PREFIX
from latentplan.objectives.expression import (
    Absolute,
    Arithmetic,
    Both,
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
from latentplan.objectives.tokens import Token, fail, split_outside_quotes, tokenize

_RELATIONS = ("<", ">", "->")
_MAX_DEPTH = 50
_SWITCH = re.compile(r"\s*(?P<start>[0-9]{1,15})\s*:(?P<text>.*)", re.DOTALL)


def parse_schedule(text: str, scales: Mapping[str, float]) -> tuple[Phase, ...]:
    """An objective, or several that follow each other: `height > 1.2; 500: speed -> 1.0`.

    Args:
        text: Objectives separated by `;`, each but the first preceded by the env frame from which it holds.
        scales: Scale of every quantity that may be named.

    Raises:
        UserError: The text is no such thing; names the position and the nearest name.
    """
    phases: list[Phase] = []
    for part in split_outside_quotes(text, ";"):
        match = _SWITCH.fullmatch(part)
        if phases and match is None:
            raise UserError(f"{part.strip()!r} needs the env frame from which it holds, as in '; 500: speed -> 1.0'")
        start = 0 if match is None else int(match["start"])
        if start <= phases[-1].start if phases else start > 0:
            raise UserError(f"env frames of {text!r} must begin with 0 (which needs not be written) and rise")
        phases.append(Phase(start, parse_objective(part if match is None else match["text"], scales)))
    return tuple(phases)


def parse_objective(text: str, scales: Mapping[str, float]) -> Expression:
    """What is to be maximised: a clause, clauses joined by `and`, or a weighted sum of such, quantities and `return`.

    Raises:
        UserError: The text is no such thing; names the position and the nearest name.
    """
    parser = _Parser(text, scales)
    return Expression(text.strip(), tuple(parser.split_sum(parser.parse(), 1.0)))


def parse_reward(text: str, scales: Mapping[str, float], setting: str) -> Expression:
    """What a body is to be paid: an objective of quantities and tasks alone, without `return` and goal images.

    Raises:
        UserError: The text is no such thing; names the setting.
    """
    expression = parse_objective(text, scales)
    if any(isinstance(term, LearnedReturn | GoalImage) for _, term in expression.terms):
        raise UserError(f"{setting} {text!r} must be made of named quantities and tasks alone")
    return expression


def parse_constraints(text: str, scales: Mapping[str, float]) -> tuple[Clause, ...]:
    """Inequalities that must hold at every moment, separated by `;` or joined by `and`.

    Raises:
        UserError: The text is no such thing; names the position and the nearest name.
    """
    return tuple(clause for part in text.split(";") for clause in _Parser(part, scales).inequalities())


class _Parser:
    def __init__(self, text: str, scales: Mapping[str, float]) -> None:
        self.text, self.scales = text.strip(), scales
        self.tokens = tokenize(self.text)
        self.index = self.depth = 0
        self.places: dict[int, int] = {}  # where a node begins, by its identity

    def parse(self) -> Node:
        """The whole text as one node."""
        node = self._conjunction()
        if self._next.kind != "end":
            self._fail(self._next, f"expected an operator or the end, got {self._next.text!r}")
        return node

    def split_sum(self, node: Node, weight: float) -> list[tuple[float, Node]]:
        """The terms of a weighted sum; only there may the learned return and goal images stand."""
        match node:
            case Arithmetic("+" | "-" as sign, left, right):
                factor = weight if sign == "+" else -weight
                return self.split_sum(left, weight) + self.split_sum(right, factor)
            case Arithmetic("*", Number(value), other) | Arithmetic("*", other, Number(value)):
                if not math.isfinite(weight * value):
                    self._fail_at(node, "a weight beyond every number")
                return self.split_sum(other, weight * value)
        if not isinstance(node, LearnedReturn | GoalImage):
            self._forbid_whole_terms(node)
        return [(weight, node)]

    def inequalities(self) -> list[Clause]:
        """The clauses of a constraint."""
        found: list[Clause] = []
        pending = [self.parse()]
        while pending:
            node = pending.pop(0)
            if isinstance(node, Both):
                pending[:0] = [node.left, node.right]
            elif isinstance(node, Clause) and node.relation != "->":
                found.append(node)
            else:
                self._fail_at(node, "a constraint is an inequality such as 'cart < 0.5', or several joined by 'and'")
        return found

    def _conjunction(self) -> Node:
        node = self._comparison()
        while self._next.text == "and":
            sign = self._take()
            right = self._comparison()
            for side in (node, right):
                if not _is_degree(side):
                    self._fail(sign, "'and' joins clauses such as height > 1.2; write weights around parentheses")
            node = self._note(Both(node, right), node)
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
        return self._note(Clause(relation.text, left, right, margin, written), left)

    def _sum(self) -> Node:
        node = self._product()
        while self._next.text in ("+", "-"):
            sign = self._take()
            node = self._note(combine(sign.text, node, self._product()), node)
        return node

    def _product(self) -> Node:
        node = self._factor()
        while self._next.text == "*":
            self._take()
            node = self._note(combine("*", node, self._factor()), node)
        return node

    def _factor(self) -> Node:
        self.depth += 1
        if self.depth > _MAX_DEPTH:
            self._fail(self._next, f"more than {_MAX_DEPTH} levels of parentheses and signs")
        token = self._take()
        node = self._read(token)
        self.places[id(node)] = token.position
        self.depth -= 1
        return node

    def _read(self, token: Token) -> Node:
        match token:
            case Token("number", text):
                if not math.isfinite(float(text)):
                    self._fail(token, f"{text} is no finite number")
                return Number(float(text))
            case Token("goal", text):
                return GoalImage(text.removeprefix("goal:").strip('"'))
            case Token("sign", "-"):
                return combine("*", Number(-1.0), self._factor())
            case Token("sign", "("):
                node = self._conjunction()
                self._expect(")")
                return node
            case Token("word", "abs"):
                self._expect("(")
                inner = self._sum()
                self._expect(")")
                return Absolute(inner)
            case Token("word", "task"):
                self._expect("(")
                task = self._take()
                self._expect(")")
                return self._quantity(task, TASK_PREFIX + task.text)
            case Token("word", "return"):
                return LearnedReturn()
            case Token("word", text) if text != "and":
                return self._quantity(token, text)
        self._fail(token, f"expected a quantity, a number or '(', got {token.text or 'the end'!r}")

    def _quantity(self, token: Token, name: str) -> Name:
        if name in self.scales:
            return Name(name)
        if self._next.text == "(":
            self._fail(token, f"unknown function {name!r}; available: abs(QUANTITY), task(NAME)")
        if not self.scales:
            self._fail(token, f"unknown quantity {name!r}: this body has no named quantities")
        nearest = difflib.get_close_matches(name, self.scales, n=1, cutoff=0.0)[0]
        available = ", ".join(self.scales)
        self._fail(token, f"unknown quantity {name!r}; available: {available}. Did you mean {nearest!r}?")

    def _check_side(self, relation: Token, side: Node) -> None:
        parts = list(walk(side))
        self._forbid_whole_terms(side)
        if any(isinstance(part, Clause | Both) for part in parts):
            self._fail(relation, "a side of a comparison is a quantity, not a clause")
        kinds = {part.name.startswith(TASK_PREFIX) for part in parts if isinstance(part, Name)}
        if len(kinds) > 1:
            self._fail(relation, "this compares a sum of rewards and quantities; put the clause in parentheses")

    def _forbid_whole_terms(self, node: Node) -> None:
        for part in walk(node):
            if isinstance(part, LearnedReturn | GoalImage):
                name = "return" if isinstance(part, LearnedReturn) else "a goal image"
                self._fail_at(part, f"{name} can only be weighted and added")

    def _scale(self, node: Node) -> float:
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
    def _next(self) -> Token:
        return self.tokens[self.index]

    def _take(self) -> Token:
        token = self.tokens[self.index]
        self.index = min(self.index + 1, len(self.tokens) - 1)
        return token

    def _expect(self, sign: str) -> None:
        token = self._take()
        if token.text != sign:
            self._fail(token, f"expected {sign!r}, got {token.text or 'the end'!r}")

    def _note(self, node: Node, first: Node) -> Node:
        self.places[id(node)] = self.places[id(first)]
        return node

    def _fail_at(self, node: Node, reason: str) -> NoReturn:
        fail(self.text, self.places[id(node)], reason)

    def _fail(self, token: Token, reason: str) -> NoReturn:
        fail(self.text, token.position, reason)


def _is_degree(node: Node) -> bool:
    is_reward = isinstance(node, Name) and node.name.startswith(TASK_PREFIX)
    return is_reward or isinstance(node, Clause | Both)
