"""Expressions over named quantities, and their values from true (simulator) or predicted (model) quantities.

A clause compares two quantities. The shortfall of a clause is the distance by which it does not hold, in units of its
margin; a degree function turns the shortfall into a number in [0, 1]. `and` multiplies degrees. The margin of a clause
is the sum of the scales of its two sides: scales add in sums and differences and multiply in products, where the scale
of a number is its absolute value.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

# An array or a tensor of any shape, or a number.
Values = Any
Lookup = Callable[[str], Values]
Degree = Callable[[Values], Values]


@dataclass(frozen=True)
class Number:
    """A constant."""

    value: float


@dataclass(frozen=True)
class Name:
    """A named quantity, or the reward of a task."""

    name: str


@dataclass(frozen=True)
class Absolute:
    """The absolute value of a quantity."""

    inner: Node


@dataclass(frozen=True)
class Arithmetic:
    """Two quantities or degrees joined by `+`, `-` or `*`."""

    operator: str
    left: Node
    right: Node


@dataclass(frozen=True)
class Clause:
    """A comparison of two quantities.

    Attributes:
        relation: `<`, `>`, or `->` (the two sides should be as near as possible).
        left: Side before the relation.
        right: Side after the relation.
        margin: Difference that counts as a shortfall of 1, above 0.
        text: The clause as the user wrote it.
    """

    relation: str
    left: Node
    right: Node
    margin: float
    text: str


@dataclass(frozen=True)
class And:
    """Two clauses joined by `and`."""

    left: Node
    right: Node


@dataclass(frozen=True)
class LearnedReturn:
    """The return that the agent was trained on: predicted rewards plus the value of the last state."""


@dataclass(frozen=True)
class GoalImage:
    """Closeness to a goal image."""

    path: str


Node = Number | Name | Absolute | Arithmetic | Clause | And | LearnedReturn | GoalImage


@dataclass(frozen=True)
class Expression:
    """A weighted sum that a planner maximises.

    Attributes:
        text: The expression as the user wrote it.
        terms: Weight and node of each term.
    """

    text: str
    terms: tuple[tuple[float, Node], ...]

    @property
    def is_return(self) -> bool:
        """Whether the expression is only the learned return, which agents maximise without an objective."""
        return len(self.terms) == 1 and self.terms[0][0] > 0.0 and isinstance(self.terms[0][1], LearnedReturn)

    @property
    def clauses(self) -> tuple[Clause, ...]:
        """All clauses, in the order of the text."""
        return tuple(part for _, term in self.terms for part in walk(term) if isinstance(part, Clause))

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all quantities, each once, in the order of the text."""
        parts = (part for _, term in self.terms for part in walk(term))
        return tuple(dict.fromkeys(part.name for part in parts if isinstance(part, Name)))


@dataclass(frozen=True)
class Phase:
    """An objective and the time at which it begins.

    Attributes:
        start: Env frame of the episode at which the objective begins.
        objective: Expression to maximise from then on.
    """

    start: int
    objective: Expression


def walk(node: Node) -> Iterator[Node]:
    """Yields a node and all nodes inside it, left to right."""
    yield node
    match node:
        case Absolute(inner):
            yield from walk(inner)
        case Arithmetic(_, left, right) | Clause(_, left, right) | And(left, right):
            yield from walk(left)
            yield from walk(right)


def combine(operator: str, left: Node, right: Node) -> Node:
    """Two nodes joined by `+`, `-` or `*`; two numbers become one number, so that a weight may be written as `-0.5`."""
    if isinstance(left, Number) and isinstance(right, Number):
        return Number(_OPERATIONS[operator](left.value, right.value))
    return Arithmetic(operator, left, right)


def evaluate(node: Node, values: Lookup, degree: Degree) -> Values:
    """The value of a term of an expression.

    Args:
        node: A node without `LearnedReturn` and `GoalImage`, which are not functions of quantities.
        values: Returns the values of a quantity by its name; all quantities have the same shape.
        degree: Turns shortfalls in margins, positive where a clause does not hold, into degrees in [0, 1].

    Returns:
        Values of the shape of the quantities; a plain number if the node names no quantity.

    Raises:
        TypeError: The node holds a learned return or a goal image.
    """
    match node:
        case Number(value):
            return value
        case Name(name):
            return values(name)
        case Absolute(inner):
            return abs(evaluate(inner, values, degree))
        case Arithmetic(operator, left, right):
            return _OPERATIONS[operator](evaluate(left, values, degree), evaluate(right, values, degree))
        case Clause():
            return degree(shortfall(node, values))
        case And(left, right):
            return evaluate(left, values, degree) * evaluate(right, values, degree)
    raise TypeError(f"{type(node).__name__} is not a function of quantities")


def shortfall(clause: Clause, values: Lookup) -> Values:
    """The distance by which a clause does not hold, in units of its margin; negative where an inequality holds."""
    left, right = (evaluate(side, values, _refuse_degree) for side in (clause.left, clause.right))
    missing = {"<": left - right, ">": right - left, "->": abs(left - right)}[clause.relation]
    return missing / clause.margin


def _refuse_degree(shortfalls: Values) -> Values:
    raise AssertionError("the parser refuses a clause inside another clause")


_OPERATIONS: dict[str, Callable[[Any, Any], Any]] = {
    "+": lambda left, right: left + right,
    "-": lambda left, right: left - right,
    "*": lambda left, right: left * right,
}
