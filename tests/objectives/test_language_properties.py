"""Laws of the language of objectives, for expressions drawn from its grammar and for any text."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from latentplan.config import UserError
from latentplan.objectives.box import scoring_degree
from latentplan.objectives.expression import evaluate
from latentplan.objectives.parser import parse_constraints, parse_objective, parse_schedule

SCALES = {"speed": 1.0, "height": 0.6, "upright": 0.5, "task.walk": 0.5}
NAMES = ("speed", "height", "upright")
numbers = st.decimals(0, 50, places=2, allow_nan=False).map(str)
measures = st.recursive(
    st.sampled_from(NAMES),
    lambda inner: st.one_of(
        inner.map(lambda text: f"abs({text})"),
        st.tuples(inner, st.sampled_from("+-"), inner).map(lambda parts: f"({' '.join(parts)})"),
        st.tuples(numbers.filter(lambda text: float(text) > 0), inner).map(" * ".join),
    ),
    max_leaves=4,
)
clauses = st.tuples(measures, st.sampled_from(["<", ">", "->"]), numbers).map(" ".join)
inequalities = st.tuples(measures, st.sampled_from("<>"), numbers).map(" ".join)
conjunctions = st.lists(clauses, min_size=1, max_size=3).map(" and ".join)
weighted = st.tuples(st.floats(0.1, 9.0).map(lambda weight: f"{weight:.2f}"), conjunctions).map(
    lambda parts: f"{parts[0]} * ({parts[1]})"
)
objectives = st.one_of(
    conjunctions, measures, st.just("return"), st.lists(weighted, min_size=2, max_size=3).map(" + ".join)
)
quantities = st.fixed_dictionaries({name: st.floats(-100, 100) for name in SCALES})


def degree(shortfalls):
    import torch

    return scoring_degree(torch.as_tensor(shortfalls)).numpy()


@given(conjunctions, quantities)
def test_degree_of_clauses_lies_between_0_and_1_and_is_1_where_all_hold(text, values):
    ((weight, node),) = parse_objective(text, SCALES).terms
    lookup = {name: np.array([value]) for name, value in values.items()}.__getitem__
    score = evaluate(node, lookup, degree)
    assert weight == 1.0 and (score >= 0.0).all() and (score <= 1.0).all()
    if "->" not in text:
        holds = all(_holds(clause, values) for clause in text.split(" and "))
        assert not holds or np.isclose(score, 1.0)


def _holds(clause, values):
    scope = {**values, "abs": abs}
    return bool(eval(clause, {"__builtins__": {}}, scope))  # the clause was drawn from the grammar above


@given(objectives)
def test_expression_keeps_its_text_and_its_names(text):
    expression = parse_objective(text, SCALES)
    assert expression == parse_objective(text, SCALES)
    assert expression.text == text and set(expression.names) == {name for name in NAMES if name in text}
    assert expression.is_return == (text == "return")


@given(objectives)
def test_blanks_and_brackets_around_an_expression_change_nothing(text):
    plain = parse_objective(text, SCALES).terms
    spaced = parse_objective(f"  {text.replace(' ', '   ')} ", SCALES).terms
    assert [weight for weight, _ in plain] == [weight for weight, _ in spaced]
    assert len(parse_objective(f"({text})", SCALES).terms) >= 1


@given(conjunctions, st.integers(1, 9), quantities)
def test_weight_multiplies_the_score(text, weight, values):
    lookup = {name: np.array([value]) for name, value in values.items()}.__getitem__
    (one, node), (many, other) = (
        parse_objective(text, SCALES).terms[0],
        parse_objective(f"{weight} * ({text})", SCALES).terms[0],
    )
    assert many == weight * one
    assert np.isclose(evaluate(node, lookup, degree), evaluate(other, lookup, degree))


@given(st.lists(inequalities, min_size=1, max_size=4))
def test_constraints_are_the_clauses_in_order(texts):
    joined = parse_constraints("; ".join(texts), SCALES)
    single = [parse_constraints(text, SCALES)[0] for text in texts]
    assert [clause.text.strip() for clause in joined] == [clause.text.strip() for clause in single] == texts


@given(st.lists(objectives, min_size=1, max_size=3))
def test_schedule_has_its_phases_in_order(texts):
    text = "; ".join(f"{100 * index}: {part}" for index, part in enumerate(texts))
    phases = parse_schedule(text, SCALES)
    assert [phase.start for phase in phases] == [100 * index for index in range(len(texts))]
    assert [phase.objective.terms for phase in phases] == [parse_objective(part, SCALES).terms for part in texts]


pieces = st.sampled_from(
    ["speed", "height", "(", ")", "<", ">", "->", "and", "*", "+", "-", "abs", "1", "goal:x", ";", ":"]
)


@given(st.text(max_size=80) | st.lists(pieces | st.text(max_size=3), max_size=60).map(" ".join))
def test_any_text_is_an_expression_or_an_error_of_one_line(text):
    for parse in (parse_objective, parse_constraints, parse_schedule):
        try:
            parse(text, SCALES)
        except UserError as error:
            assert len(str(error)) <= 1000
