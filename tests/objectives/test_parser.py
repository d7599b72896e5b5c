"""The parser reads objectives, schedules and constraints, and names the position of every error."""

import math

import pytest

from latentplan.config import UserError
from latentplan.config.quantities import scales
from latentplan.objectives.expression import Clause, evaluate, shortfall
from latentplan.objectives.parser import parse_constraints, parse_objective, parse_schedule

WALKER = scales("walker")
VALUES = {"height": 1.0, "speed": -0.5, "upright": 0.9, "task.stand": 0.8, "task.walk": 0.3}


def degree(shortfall):
    return 1.0 if shortfall <= 0 else math.exp(-shortfall)


def value(text):
    expression = parse_objective(text, WALKER)
    return sum(weight * evaluate(term, VALUES.__getitem__, degree) for weight, term in expression.terms)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("speed", -0.5),
        ("1 + 2 * 3 - 4", 3.0),
        ("-speed * 2", 1.0),
        ("2 - -speed", 1.5),
        ("(1 + 1) * (height - speed)", 3.0),
        ("abs(speed) * abs(-2)", 1.0),
        ("1.5e1 * .5", 7.5),
        ("task(stand)", 0.8),
        ("task.stand - task.walk", 0.5),
        ("height > 0.9", 1.0),
        ("height<0.9", math.exp(-0.1 / 0.6)),
        ("height > 1.6", math.exp(-1.0)),
        ("speed -> -1.0", math.exp(-0.5)),
        ("speed->-0.5", math.exp(0.0)),
        ("abs(speed) < 0.2 and height > 1.3", math.exp(-0.3 - 0.5)),
        ("speed > 0 and height > 1.3 and upright > 1.4", math.exp(-0.5 - 0.5 - 1.0)),
        ("task(stand) and speed -> 0.5", 0.8 * math.exp(-1.0)),
        ("0.7 * task(stand) + 0.3 * (speed -> 0.5)", 0.56 + 0.3 * math.exp(-1.0)),
        ("-(speed > 0) + (height > 0.5) * 3", 3.0 - math.exp(-0.5)),
    ],
)
def test_parse_objective_follows_the_rules_of_arithmetic(text, expected):
    assert value(text) == pytest.approx(expected)


@pytest.mark.parametrize(
    ("text", "margin"),
    [
        ("speed -> 2", 1.0),
        ("abs(speed) < 0.2", 1.0),
        ("height > 1.2", 0.6),
        ("1.2 < 2 * height", 1.2),
        ("height - 0.5 * speed > 1", 1.1),
        ("speed * height -> 0", 0.6),
        ("-3 * speed < 1", 3.0),
    ],
)
def test_clause_margin_is_the_scale_of_its_sides(text, margin):
    (clause,) = parse_objective(text, WALKER).clauses
    assert clause.margin == pytest.approx(margin)


@pytest.mark.parametrize(
    ("text", "position", "reason"),
    [
        ("", 1, "got 'the end'"),
        ("hight > 1", 1, "unknown quantity 'hight'; available: height, speed"),
        ("hight > 1", 1, "Did you mean 'height'?"),
        ("height > 1 and sped -> 2", 16, "Did you mean 'speed'?"),
        ("task(wlak)", 6, "Did you mean 'task.walk'?"),
        ("sin(speed) > 0", 1, "unknown function 'sin'; available: abs"),
        ("height > ", 9, "got 'the end'"),
        ("height >> 1", 9, "expected a quantity"),
        ("0 < speed < 1", 11, "a comparison has two sides"),
        ("1 < 2", 3, "needs a quantity"),
        ("(height > 1) > 0.5", 14, "not a clause"),
        ("speed and height > 1", 7, "'and' joins clauses"),
        ("2 * (speed > 1) and height > 1", 17, "write weights around parentheses"),
        ("0.7 * task(stand) + 0.3 * speed -> 1", 33, "put the clause in parentheses"),
        ("(height > 1", 12, "expected an operator or ')', got 'the end'"),
        ("task()", 6, "expected the name of a task, got ')'"),
        ("abs(speed > 1)", 11, "abs() takes a quantity, not a comparison"),
        ('goal:"end.png', 5, "write goal:FILE"),
        ("1e308 * 10 * speed", 7, "too large for a number"),
        ("height > 1)", 11, "expected an operator or the end"),
        ("height > 1 or speed > 1", 12, "expected an operator or the end, got 'or'"),
        ("height = 1", 8, "unexpected '='; clauses compare by <, > and ->"),
        ("height >= 1", 9, "unexpected '='; clauses compare by <, > and ->"),
        ("__import__('os')", 12, "unexpected"),
        ("speed > 1e999", 9, "too large for a number"),
        ("10 * speed * 1e308", 1, "this weight is too large for a number"),
        ("return > 5", 1, "return can only be weighted and added"),
        ("speed * return", 9, "return can only be weighted and added"),
        ("abs(goal:a.png)", 5, "a goal image can only be weighted and added"),
        ("(" * 60 + "speed" + ")" * 60, 51, "levels"),
        ("speed" + " + speed" * 300, 801, "at most 200"),
    ],
)
def test_parse_objective_names_position_and_reason_when_text_is_invalid(text, position, reason):
    with pytest.raises(UserError) as error:
        parse_objective(text, WALKER)
    assert f"position {position}: " in str(error.value)
    assert reason in str(error.value)


@pytest.mark.parametrize(
    "text", ["(" * 100_000, "-" * 100_000, "9" * 100_000, "a" * 100_000, "goal:" + "a" * 100_000 + "("]
)
def test_parse_objective_refuses_very_long_text_in_one_short_line(text):
    with pytest.raises(UserError) as error:
        parse_objective(text, WALKER)
    assert len(str(error.value)) < 500 and "\n" not in str(error.value)


def test_parse_objective_says_that_a_body_has_no_quantities():
    with pytest.raises(UserError, match="no named quantities"):
        parse_objective("speed > 1", {})


def test_parse_objective_splits_return_and_goal_images_into_weighted_terms():
    expression = parse_objective('0.5 * return - 2 * (goal:"my goal.png" + height)', WALKER)
    found = [(weight, type(term).__name__) for weight, term in expression.terms]
    assert found == [(0.5, "LearnedReturn"), (-2.0, "GoalImage"), (-2.0, "Name")]
    assert expression.terms[1][1].path == "my goal.png"
    assert parse_objective("goal:a-b/c.png", WALKER).terms[0][1].path == "a-b/c.png"


def test_parse_schedule_reads_the_env_frame_of_each_objective():
    phases = parse_schedule("abs(speed) < 0.2; 500: speed -> 1.0;750:goal:end.png", WALKER)
    assert [(phase.start, phase.objective.text) for phase in phases] == [
        (0, "abs(speed) < 0.2"),
        (500, "speed -> 1.0"),
        (750, "goal:end.png"),
    ]
    named = parse_schedule('goal:"im/a;b.png"; 500: speed', WALKER)
    assert [phase.start for phase in named] == [0, 500] and named[0].objective.terms[0][1].path == "im/a;b.png"
    assert parse_schedule("0: speed", WALKER) == parse_schedule("speed", WALKER)


LONG = f"speed; {'9' * 5000}: height"


@pytest.mark.parametrize(
    "text", ["10: speed", "speed; 5: height; 5: speed", "speed; height", "speed; 0: height", LONG], ids=range(5)
)
def test_parse_schedule_refuses_env_frames_that_do_not_increase(text):
    with pytest.raises(UserError, match="env frame"):
        parse_schedule(text, WALKER)


def test_clause_text_is_the_text_of_the_user():
    clauses = parse_objective("2 * (abs(speed)  < 0.2) + (height > 1.2 and upright > 0)", WALKER).clauses
    assert [clause.text for clause in clauses] == ["abs(speed)  < 0.2", "height > 1.2", "upright > 0"]


def test_parse_constraints_returns_one_clause_per_inequality():
    clauses = parse_constraints("abs(speed) < 0.2; height > 1 and upright > 0", WALKER)
    assert [(type(clause), clause.relation) for clause in clauses] == [(Clause, "<"), (Clause, ">"), (Clause, ">")]
    assert [shortfall(clause, VALUES.__getitem__) for clause in clauses] == pytest.approx([0.3, 0.0, -1.8])


@pytest.mark.parametrize("text", ["speed -> 1", "speed", "0.5 * (speed < 1)", "return", "speed < 1 and task(stand)"])
def test_parse_constraints_refuses_text_that_is_not_an_inequality(text):
    with pytest.raises(UserError, match="a constraint is an inequality"):
        parse_constraints(text, WALKER)


@pytest.mark.parametrize("text", ["height > 1;", "; height > 1", " height > 1 ; ; ", "height > 1"])
def test_blank_parts_are_skipped(text):
    assert [clause.text for clause in parse_constraints(text, WALKER)] == ["height > 1"]
    assert [(phase.start, phase.objective.text) for phase in parse_schedule(text, WALKER)] == [(0, "height > 1")]


@pytest.mark.parametrize("text", ["", "  ", " ; ;"])
def test_blank_text_gives_no_constraints_and_is_no_objective(text):
    assert parse_constraints(text, WALKER) == ()
    with pytest.raises(UserError, match="position 1: "):
        parse_schedule(text, WALKER)


@pytest.mark.parametrize(
    ("parse", "text", "position"),
    [
        (parse_constraints, "height > 1; sped < 2", 13),
        (parse_constraints, "  height > 1;; upright > 0; speed -> 1", 27),
        (parse_constraints, "height > 1; speed > ", 20),
        (parse_constraints, "height > 1; speed > ; upright > 0", 20),
        (parse_schedule, "height > 1; 500: sped -> 1", 18),
        (parse_schedule, "height > 1; 500: ; 800: speed", 17),
    ],
)
def test_error_in_a_later_part_names_its_position_in_the_whole_text(parse, text, position):
    with pytest.raises(UserError) as error:
        parse(text, WALKER)
    assert f"expression {text.strip()!r}, position {position}: " in str(error.value)
