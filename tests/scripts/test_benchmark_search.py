"""`benchmark.py search`: closed loops at equal evaluations and at equal milliseconds, and the simulated problems."""

import json
import math
import re
from statistics import fmean, stdev

import benchmark
import pytest
import torch
from bench import search
from bench.controllers.own import controller
from bench.controllers.serve import Entry, play
from bench.controllers.task import NAMES, Task, find_problem
from bench.search import Arm, compare_best, fit_iterations
from bench.simulated_problems import SIMULATED

from latentplan.planning import PLANNERS, check_model

KEYS = {"problem", "planner", "library", "cost_mean", "cost_sd", "evaluations", "ms_p50"}
SMALL = "--samples 8 --iterations 2 --timed 1 --tuning-seeds 1 --peers none".split()


@pytest.fixture(scope="module")
def problems():
    return {name: make() for name, make in SIMULATED.items()}


@pytest.fixture(scope="module")
def result(tmp_path_factory):
    """The result of all planners of this library on two problems, with two seeds."""
    path = tmp_path_factory.mktemp("search") / "result.json"
    assert benchmark.main(["search", *SMALL, "--problems", "lq,navigation", "--seeds", "2", "--json", str(path)]) == 0
    return json.loads(path.read_text())


@pytest.mark.parametrize("name", SIMULATED)
def test_simulated_problem_is_a_model_that_can_be_planned_with(problems, name):
    problem = problems[name]
    check_model(problem.model(), problem.start([0, 1]), problem.action_dim)


@pytest.mark.parametrize("name", SIMULATED)
def test_start_depends_on_its_own_seed_only(problems, name):
    starts = problems[name].start([3, 4])
    assert torch.equal(starts[1:], problems[name].start([4])) and not torch.equal(starts[0], starts[1])


@pytest.mark.parametrize("name", SIMULATED)
def test_planning_costs_less_than_no_action(problems, name):
    task = Task(problem=problems[name], samples=64, iterations=2)
    planned = play(Entry(controller("icem"), is_batched=True), task, [100])["costs"]
    idle = problems[name].run(lambda state: torch.zeros(1, problems[name].action_dim), [100]).tolist()
    assert planned[0] < 0.9 * idle[0]


def test_humanoid_has_forty_actions(problems):
    assert problems["humanoid"].action_dim == 40


def test_box_moves_only_when_the_ball_pushes_it(problems):
    problem = problems["push"]
    state = problem.start([0])
    following = problem.dynamics(state, torch.zeros(1, 2))
    assert torch.equal(following[:, 3:6], state[:, 3:6])  # place and angle of the box


def test_every_name_of_the_flag_is_a_problem():
    assert set(search.PROBLEM_NAMES) == set(NAMES)


def test_model_counts_every_step_and_steps_with_gradients_thrice(problems):
    task = Task(problem=problems["push"], samples=8, iterations=2)
    model, state = task.model(), problems["push"].start([0, 1])
    with torch.no_grad():
        model.step(state, torch.zeros(2, 2))
        model.rollout(state, torch.zeros(2, 5, 2))
    assert task.rows == 2 + 10
    lq = Task(problem=find_problem("lq"), samples=8, iterations=2)
    assert not hasattr(lq.model(), "rollout")
    lq.model().step(lq.problem.start([0]), torch.zeros(1, 30))
    assert lq.rows == 3


def test_rows_have_the_promised_keys_for_every_planner_and_budget(result):
    assert all(row.keys() >= KEYS for row in result["rows"])
    found = [(row["problem"], row["planner"], row["budget"]) for row in result["rows"]]
    budgets = ("evaluations", "milliseconds")
    assert sorted(found) == sorted(
        (problem, planner + width, budget)
        for problem in ("lq", "navigation")
        for planner in PLANNERS
        for width in ("", "-tuned")
        for budget in budgets
    )


def test_rows_summarise_the_cost_of_every_seed(result):
    for row in result["rows"]:
        assert len(row["costs"]) == 2
        assert row["cost_mean"] == pytest.approx(fmean(row["costs"]))
        assert row["cost_sd"] == pytest.approx(stdev(row["costs"]))
        assert row["ms_p50"] > 0.0


@pytest.mark.parametrize("problem", ["lq", "navigation"])
@pytest.mark.parametrize("name", PLANNERS)
def test_every_planner_spends_its_budget_and_no_more(name, problem):
    """What is evaluated to choose and to refine the executed sequence counts too."""
    task = Task(problem=find_problem(problem), samples=100, iterations=3)
    evaluations = play(Entry(controller(name), is_batched=True), task, [0, 1])["evaluations"]
    # The iterations have equally many sequences, so a rest of up to 2 is left; a pausing ascent saves 3 times 6.
    least = 300 - 2 - (18 if name == "cem_gradient" else 0)
    assert least <= evaluations <= 300


def test_planners_without_gradient_spend_the_budget_of_the_rows(result):
    spent = {row["planner"]: row["evaluations"] for row in result["rows"] if row["budget"] == "evaluations"}
    assert all(16 - 1 <= number <= 16 for name, number in spent.items() if "gradient" not in name)


def test_play_repeats_and_does_not_depend_on_the_other_seeds():
    def cost(seeds):
        task = Task(problem=find_problem("lq"), samples=8, iterations=2)
        return play(Entry(controller("icem"), is_batched=True), task, seeds)["costs"]

    assert cost([0, 1]) == cost([0, 1])
    assert cost([0, 1])[1] == pytest.approx(cost([1])[0], rel=1e-4)


def test_earlier_rows_join_the_result(result, tmp_path, capsys):
    earlier, joined = tmp_path / "earlier.json", tmp_path / "joined.json"
    other = [row | {"library": "other", "costs": [cost + 1.0 for cost in row["costs"]]} for row in result["rows"]]
    other = [row | {"cost_mean": row["cost_mean"] + 1.0} for row in other]
    earlier.write_text(json.dumps(result | {"rows": other}))
    flags = ["--problems", "lq", "--planners", "icem", "--seeds", "2", "--earlier", str(earlier), "--json", str(joined)]
    assert benchmark.main(["search", *SMALL, *flags]) == 0
    rows = json.loads(joined.read_text())["rows"]
    assert {row["library"] for row in rows} == {"latentplan", "other"}
    assert "other cem" in capsys.readouterr().out


def test_one_budget_alone_can_be_asked_for(tmp_path):
    path = tmp_path / "result.json"
    flags = ["--problems", "lq", "--planners", "icem", "--seeds", "2", "--budgets", "milliseconds"]
    assert benchmark.main(["search", *SMALL, *flags, "--json", str(path)]) == 0
    assert [row["budget"] for row in json.loads(path.read_text())["rows"]] == ["milliseconds"]


def test_best_planners_of_the_tuning_seeds_are_compared_seed_by_seed():
    def row(library, planner, tuning_cost, costs):
        facts = {"problem": "lq", "budget": "evaluations", "library": library, "planner": planner}
        return {**facts, "tuning_cost": tuning_cost, "costs": costs, "cost_mean": fmean(costs)}

    rows = [row("latentplan", "cem", 9.0, [0.0, 0.0]), row("latentplan", "icem", 2.0, [1.0, 3.0])]
    rows += [row("peer", "A", 3.0, [2.0, 6.0]), row("peer", "B", 4.0, [0.0, 0.0])]
    (best,) = compare_best(rows, "lq")
    assert (best["ours"], best["peer"]) == ("icem", "peer A")
    assert best["difference"] == -2.0
    assert best["ci95"][0] < -2.0 < best["ci95"][1]


@pytest.mark.parametrize(
    ("budget_ms", "one_ms", "all_ms", "iterations", "fitting"),
    [(10.0, 4.0, 10.0, 3, 3), (10.0, 40.0, 100.0, 3, 1), (100.0, 4.0, 10.0, 3, 36), (10.0, 2.0, 2.0, 1, 5)],
)
def test_fitting_iterations_stay_within_a_tenth_of_the_budget(budget_ms, one_ms, all_ms, iterations, fitting):
    assert fit_iterations(budget_ms, one_ms, all_ms, iterations) == fitting


class FakeProcess:
    """Answers with a cost that depends on the settings alone."""

    def ask(self, request):
        return {"costs": [request["settings"]["cost"]] * len(request["seeds"]), "evaluations": 1.0}


def test_settings_with_the_lowest_finite_cost_are_chosen():
    choices = [{"cost": value} for value in (math.nan, 3.0, 2.0, 4.0)]
    arm = Arm("peer", "A", "lq", FakeProcess(), choices)
    arm.choose(search.Request())
    assert arm.settings == {"cost": 2.0}
    assert arm.tuning_cost == 2.0


class FailingProcess:
    """Plays at a cost of its number of iterations; fails at a task with a number of iterations."""

    def __init__(self, do="", iterations=0):
        self.fails_at = (do, iterations)

    def ask(self, request):
        if (request["do"], request["iterations"]) == self.fails_at:
            return {"error": "it broke"}
        if request["do"] == "time":
            return {"ms": float(request["iterations"])}
        return {"costs": [float(request["iterations"])] * len(request["seeds"]), "evaluations": 1.0}


def compare_with(failing):
    arms = [Arm("latentplan", "cem", "lq", FailingProcess(), [{}]), Arm("peer", "A", "lq", failing, [{}])]
    left_out = {}
    rows = search.compare(arms, search.Request(seeds=2, timed=1, iterations=3), 5.0, left_out)
    return [(row["planner"], row["budget"], row["iterations"], row["cost_mean"]) for row in rows], left_out


CEM_ROWS = [("cem", "evaluations", 3, 3.0), ("cem", "milliseconds", 5, 5.0)]


def test_planner_that_fails_within_the_milliseconds_has_no_row_there():
    rows, left_out = compare_with(FailingProcess("run", 5))
    assert rows == [CEM_ROWS[0], ("A", "evaluations", 3, 3.0), CEM_ROWS[1]]
    assert left_out == {"peer A on lq": "it broke"}


@pytest.mark.parametrize(("seed", "words"), [(0, "on a reported start"), (100, "on the starts for tuning")])
def test_planner_whose_cost_is_not_finite_is_left_out(seed, words):
    class Diverging(FailingProcess):
        def ask(self, request):
            answer = super().ask(request)
            return answer | {"costs": [*answer["costs"][1:], math.nan]} if seed in request.get("seeds", ()) else answer

    rows, left_out = compare_with(Diverging())
    assert rows == CEM_ROWS
    assert list(left_out) == ["peer A on lq"] and words in left_out["peer A on lq"]


@pytest.mark.parametrize(("iterations", "rows_left"), [(3, 0), (1, 1), (5, 1)])
def test_planner_that_fails_while_it_is_timed_is_left_out(iterations, rows_left):
    rows, left_out = compare_with(FailingProcess("time", iterations))
    assert [row for row in rows if row[0] == "cem"] == CEM_ROWS
    assert [row[1] for row in rows if row[0] == "A"] == ["evaluations"] * rows_left
    assert left_out == {"peer A on lq": "it broke"}


@pytest.mark.parametrize(
    ("flags", "named"),
    [
        (["--samples", "9"], "samples 8, this call 9"),
        (["--iterations", "3"], "iterations 2, this call 3"),
        (["--tuning-seeds", "2"], "tuning_seeds 1, this call 2"),
        (["--threads", "2"], "threads 1, this call 2"),
        (["--budgets", "evaluations"], "budgets"),
        (["--budget-ms", "9"], "budget_ms"),
        (["--seeds", "3"], "seeds 2, this call 3"),
    ],
)
def test_earlier_result_of_other_settings_is_refused_in_one_line(result, tmp_path, capsys, flags, named):
    earlier = tmp_path / "earlier.json"
    earlier.write_text(json.dumps(result))
    given = [*SMALL, "--problems", "lq", "--planners", "icem", "--seeds", "2", "--earlier", str(earlier)]
    assert benchmark.main(["search", *given, *flags]) == 2
    captured = capsys.readouterr()
    assert captured.err.count("\n") == 1 and "--earlier" in captured.err and named in captured.err


@pytest.mark.parametrize(
    ("budget_ms", "words"), [(None, "did not note its milliseconds"), (9.0, "different milliseconds on lq")]
)
def test_earlier_results_of_other_milliseconds_are_refused_in_one_line(result, tmp_path, capsys, budget_ms, words):
    paths = tmp_path / "a.json", tmp_path / "b.json"
    for path, value in zip(paths, (budget_ms, 3.0), strict=True):
        rows = [row | {"budget_ms": value if row["budget"] == "milliseconds" else None} for row in result["rows"]]
        path.write_text(json.dumps(result | {"rows": rows}))
    given = ["--problems", "lq", "--planners", "icem", "--seeds", "2", "--earlier", ",".join(map(str, paths))]
    assert benchmark.main(["search", *SMALL, *given]) == 2
    captured = capsys.readouterr()
    assert captured.err.count("\n") == 1 and words in captured.err


def test_planners_get_the_milliseconds_of_earlier_results(result):
    (budget_ms,) = {row["budget_ms"] for row in result["rows"] if row["problem"] == "lq" and row["budget_ms"]}
    assert search.find_budget_ms(search.Request(), result["rows"], "lq") == budget_ms
    assert search.find_budget_ms(search.Request(budget_ms=2.0), result["rows"], "lq") == 2.0
    assert search.find_budget_ms(search.Request(), [], "lq") is None


def test_peers_alone_have_no_milliseconds_of_their_own(capsys):
    left_out = {}
    arms = [Arm("peer", "A", "lq", FailingProcess(), [{}])]
    rows = search.compare(arms, search.Request(seeds=2, timed=1, iterations=3), None, left_out)
    assert [row["budget"] for row in rows] == ["evaluations"]
    assert "no planner of this library is left" in capsys.readouterr().out


def test_library_that_cannot_be_installed_is_left_out_in_one_line(tmp_path, monkeypatch, capsys):
    (tmp_path / "file").write_text("in the way of an environment")
    monkeypatch.setattr(search, "FOLDER", tmp_path / "file")
    flags = ["--peers", "mbrl", "--problems", "lq", "--planners", "mppi", "--seeds", "2"]
    assert benchmark.main(["search", *SMALL[:-2], *flags]) == 0
    assert re.search(r"^mbrl left out: .*; to install it: .* -m pip install .* mbrl ", capsys.readouterr().out, re.M)


def test_search_refuses_an_unknown_planner_before_it_installs_others(monkeypatch, capsys):
    monkeypatch.setattr(search, "install", lambda name, _: pytest.fail(f"installs {name}"))
    assert benchmark.main(["search", "--planners", "icme", "--peers", "mbrl"]) == 2
    assert "unknown planner 'icme'; did you mean 'icem" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["--problems", "pendulun"], "'pendulum'"),
        (["--peers", "torchlr"], "'torchrl'"),
        (["--planners", "icme", "--peers", "none"], "'icem'"),
        (["--seeds", "1"], "--seeds"),
        (["--budgets", "evaluation"], "'evaluations'"),
        (["--budget-ms", "0"], "--budget-ms"),
        (["--planners", "none"], "--budget-ms"),
        (["--earlier", "no_such.json"], "no_such.json"),
    ],
)
def test_main_refuses_bad_flags_in_one_line_that_names_the_flag(capsys, arguments, named):
    assert benchmark.main(["search", *arguments]) == 2
    captured = capsys.readouterr()
    assert captured.err.count("\n") == 1
    assert named in captured.err
