"""What expressions over named quantities mean, whoever knows the values: the simulator or a model.

A clause compares two quantities. What is missing for it to hold, in units of its margin, is its shortfall; a degree
function turns that into a number in [0, 1]. `and` multiplies degrees. The margin of a clause is the scale of what it
compares: scales add in sums and differences, and multiply in products, where a number counts as itself.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

from latentplan.config import UserError

# An array or a tensor of any shape; numbers broadcast with both.
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
    """The size of a quantity, without its sign."""

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
        relation: `<`, `>`, or `->`: as near as possible.
        left: One side.
        right: The other.
        margin: Shortfall that counts as 1, above 0.
        text: How it was written.
    """

    relation: str
    left: Node
    right: Node
    margin: float
    text: str


@dataclass(frozen=True)
class Both:
    """Two clauses that must hold at once."""

    left: Node
    right: Node


@dataclass(frozen=True)
class LearnedReturn:
    """The return that the agent was trained for: reward, and the value of what comes after."""


@dataclass(frozen=True)
class GoalImage:
    """Closeness to a picture of the goal."""

    path: str


Node = Number | Name | Absolute | Arithmetic | Clause | Both | LearnedReturn | GoalImage


@dataclass(frozen=True)
class Expression:
    """A weighted sum, to be maximised.

    Attributes:
        text: How it was written.
        terms: Weight and content of each part.
    """

    text: str
    terms: tuple[tuple[float, Node], ...]

    @property
    def is_return(self) -> bool:
        """Whether nothing but the learned return is wanted, which is what agents pursue without an objective."""
        return len(self.terms) == 1 and self.terms[0][0] > 0.0 and isinstance(self.terms[0][1], LearnedReturn)

    @property
    def clauses(self) -> tuple[Clause, ...]:
        """Every clause, in the order of the text."""
        return tuple(part for _, term in self.terms for part in walk(term) if isinstance(part, Clause))

    @property
    def names(self) -> tuple[str, ...]:
        """Every quantity that is looked up, each once."""
        parts = (part for _, term in self.terms for part in walk(term))
        return tuple(dict.fromkeys(part.name for part in parts if isinstance(part, Name)))


@dataclass(frozen=True)
class Phase:
    """An objective and when it begins to hold.

    Attributes:
        start: Env frame of the episode.
        objective: What is maximised from then on.
    """

    start: int
    objective: Expression


def walk(node: Node) -> Iterator[Node]:
    """The node and everything in it, left to right."""
    yield node
    match node:
        case Absolute(inner):
            yield from walk(inner)
        case Arithmetic(_, left, right) | Clause(_, left, right) | Both(left, right):
            yield from walk(left)
            yield from walk(right)


def combine(operator: str, left: Node, right: Node) -> Node:
    """Two nodes joined by `+`, `-` or `*`; two numbers become one, so that a weight may be written as `-0.5`."""
    if isinstance(left, Number) and isinstance(right, Number):
        value = _OPERATIONS[operator](left.value, right.value)
        if not math.isfinite(value):
            raise UserError(f"{left.value:g} {operator} {right.value:g} is not finite")
        return Number(value)
    return Arithmetic(operator, left, right)


def evaluate(node: Node, values: Lookup, degree: Degree) -> Values:
    """What a term of an expression is worth.

    Args:
        node: Without learned return or goal image, which are no functions of quantities.
        values: Gives the values of a quantity, all of one shape.
        degree: Turns shortfalls in margins, positive where a clause does not hold, into degrees in [0, 1].

    Returns:
        Values of that shape; a plain number where the node holds no name.
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
        case Both(left, right):
            return evaluate(left, values, degree) * evaluate(right, values, degree)
    raise TypeError(f"{type(node).__name__} is no function of quantities")


def shortfall(clause: Clause, values: Lookup) -> Values:
    """What is missing for a clause to hold, in units of its margin; below 0 where an inequality holds."""
    left, right = (evaluate(side, values, _no_degree) for side in (clause.left, clause.right))
    missing = {"<": left - right, ">": right - left, "->": abs(left - right)}[clause.relation]
    return missing / clause.margin


def _no_degree(shortfalls: Values) -> Values:
    raise AssertionError("the parser lets no clause into another")


_OPERATIONS: dict[str, Callable[[Any, Any], Any]] = {
    "+": lambda left, right: left + right,
    "-": lambda left, right: left - right,
    "*": lambda left, right: left * right,
}
