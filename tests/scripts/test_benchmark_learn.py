"""`benchmark.py learn`: curves, tables, and finished runs that are not repeated."""

import csv
import json
import signal
from dataclasses import replace

import benchmark
import numpy as np
import pytest
from bench.anchors import TASK_GROUPS
from bench.estimates import interquartile_estimate, mean_estimate
from bench.learn import Request, _train, compare, first_reaching, read_run, run_facts
from bench.learn_plot import MARKERS, Curve, Point
from bench.run_evaluations import keep_final
from bench.runs import TrainingRun, check_same

from latentplan.config import Config, EnvConfig, PlannerConfig, RunConfig, UserError
from latentplan.config.files import dump_config
from latentplan.reporting.published import METHODS, METHODS_AT_REPEAT_2, published_returns_of

HEADER = "env_frames,updates,minutes,planner_return,actor_return\n"


def test_first_reaching_returns_the_first_evaluation_above_a_threshold():
    curve = Curve("walker-walk", 0, [Point(10, 1.0, 50.0), Point(20, 2.0, 400.0), Point(30, 3.0, 300.0)])
    assert first_reaching(curve, 300) == Point(20, 2.0, 400.0)
    (facts,) = run_facts([curve], [300, 900])
    assert facts["frames_to"] == {"300": 20, "900": None}
    assert facts["final_return"] == 300.0


def test_read_run_ends_with_the_final_evaluation(tmp_path):
    (tmp_path / "metrics.csv").write_text(HEADER + "80,7,4.0,1,2\n100,9,5.0,3,4\n")
    assert read_run("walker-walk", 0, tmp_path, "actor").points == [Point(80, 4.0, 2.0), Point(100, 5.0, 4.0)]
    (tmp_path / "final.json").write_text(
        json.dumps({"env_frames": 100, "updates": 9, "minutes": 5.5, "planner": 7, "actor": 8})
    )
    assert read_run("walker-walk", 0, tmp_path, "actor").points == [Point(80, 4.0, 2.0), Point(100, 5.5, 8.0)]


def test_read_run_keeps_the_final_evaluation_of_a_shorter_budget(tmp_path):
    (tmp_path / "metrics.csv").write_text(HEADER + "80,7,4.0,1,2\n")
    keep_final(tmp_path)  # before the run has a final evaluation
    for frames, minutes in ((100, 5.0), (200, 9.0)):
        final = {"env_frames": frames, "updates": frames, "minutes": minutes, "planner": frames, "actor": 0}
        (tmp_path / "final.json").write_text(json.dumps(final))
        if frames == 100:
            keep_final(tmp_path)
    points = [Point(80, 4.0, 1.0), Point(100, 5.0, 100), Point(200, 9.0, 200)]
    assert read_run("walker-walk", 0, tmp_path, "planner").points == points
    (tmp_path / "metrics.csv").write_text(HEADER + "80,7,4.0,1,2\n100,8,5.0,3,4\n")  # of fewer episodes
    assert read_run("walker-walk", 0, tmp_path, "planner").points == points


def test_read_run_ends_at_its_budget_in_the_folder_of_a_longer_run(tmp_path):
    (tmp_path / "metrics.csv").write_text(HEADER + "80,7,4.0,1,2\n101,9,5.0,3,4\n200,12,9.0,5,6\n")
    assert read_run("walker-walk", 0, tmp_path, "planner", 100).points[-1] == Point(101, 5.0, 3.0)
    assert read_run("walker-walk", 0, tmp_path, "planner").points[-1] == Point(200, 9.0, 5.0)
    with pytest.raises(UserError, match="holds no evaluation within 60 frames"):
        read_run("walker-walk", 0, tmp_path, "planner", 60)


def test_finals_of_one_budget_do_not_mix_with_those_of_a_longer_one(tmp_path):
    for seed, frames in ((0, 200), (1, 100)):
        folder = tmp_path / f"walker-walk-seed{seed}"
        folder.mkdir()
        (folder / "finished.json").write_text(json.dumps({"budget": ["--frames", str(frames)]}))
        rows = "".join(f"{at},9,3,{at},1\n" for at in range(100, frames + 1, 100))
        (folder / "metrics.csv").write_text(HEADER + rows)
    flags = ["--tasks", "walker-walk", "--frames", "100", "--out", str(tmp_path)]
    assert benchmark.main(["learn", *flags]) == 0
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert [run["env_frames"] for run in summary["runs"]] == [100, 100]
    assert summary["final"]["walker-walk"]["mean"] == 100.0


def test_read_run_refuses_an_evaluation_that_is_not_finite(tmp_path):
    (tmp_path / "metrics.csv").write_text(HEADER + "80,7,4.0,1,2\n100,9,5.0,nan,4\n")
    with pytest.raises(UserError, match="is not finite, at 100 frames"):
        read_run("walker-walk", 0, tmp_path, "planner")


def test_read_run_refuses_damaged_final_evaluations_of_shorter_budgets(tmp_path):
    (tmp_path / "metrics.csv").write_text(HEADER + "80,7,4.0,1,2\n")
    (tmp_path / "finals.json").write_text("{")
    with pytest.raises(UserError, match="finals.json is damaged; remove it"):
        read_run("walker-walk", 0, tmp_path, "planner")


def test_compare_sets_runs_beside_published_returns_at_the_same_frames():
    curves = [
        Curve("walker-walk", seed, [Point(60_000, 30.0, 100.0), Point(100_500, 60.0, final)])
        for seed, final in enumerate((500.0, 700.0, 900.0))
    ]
    rows = compare("walker-walk", curves, [600, 800])
    own, other = rows["latentplan"], rows["DreamerV3"]
    assert own["returns"] == {100_000: 700.0} and own["intervals"][100_000][0] < 700.0
    assert own["frames_to"] == {"600": 100_500, "800": None}
    assert (other["returns"][100_000], other["frames_to"]) == (625.3, {"600": 100_000, "800": 200_000})
    assert rows["ResAct (own repeat)"]["returns"] == {100_000: 772}
    assert list(compare("fish-swim", [curves[0]._replace(task="fish-swim")], [600])) == ["latentplan"]


def test_every_published_method_has_a_name_and_a_marker_and_every_task_of_dmc20_has_methods():
    known = {task: published_returns_of(task) for task in TASK_GROUPS["dmc20"]}
    assert {method for returns in known.values() for method in returns} == set(METHODS)
    assert len(MARKERS) == len(METHODS) and list(known["walker-run"]) == list(METHODS_AT_REPEAT_2)
    assert all({"DreamerV3", "MR.Q", "DrQ-v2", "CURL"} <= set(returns) for returns in known.values())
    assert set(TASK_GROUPS["dev"]) < set(TASK_GROUPS["dmc20"])


def test_learn_collects_finished_runs_without_repeating_them(tmp_path, capsys):
    for seed in (0, 1):
        folder = tmp_path / f"walker-walk-seed{seed}"
        folder.mkdir()
        (folder / "finished.json").write_text(json.dumps({"budget": ["--frames", "100"]}))
        rows = f"{HEADER}50,5,1,{seed},0\n60,6,2,,\n100,9,3,{seed + 300},1\n"
        (folder / "metrics.csv").write_text(rows)
    flags = ["--tasks", "walker-walk", "--frames", "100", "--out", str(tmp_path)]
    assert benchmark.main(["learn", *flags]) == 0
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["final"]["walker-walk"]["mean"] == 300.5
    assert summary["anchors"]["walker-walk"]["TD-MPC2"]["frames_to"]["750"] == 200_000
    assert len(list(csv.DictReader((tmp_path / "curves.csv").open()))) == 4
    assert (tmp_path / "curves.png").stat().st_size > 0
    printed = capsys.readouterr().out
    assert "not repeated" in printed and "EfficientZero V2" in printed


@pytest.mark.parametrize("ending", [SystemExit(143), RuntimeError()])
def test_learn_leaves_no_run_behind_when_it_ends(tmp_path, monkeypatch, ending):
    """SIGTERM ends a command by SystemExit; the run gets a SIGTERM too, and saves itself before the command ends."""
    calls = []

    class Training:
        def __init__(self, command):
            self.endings = [ending]

        def wait(self):
            calls.append("wait")
            if self.endings:
                raise self.endings.pop()
            return 143

        def terminate(self):
            calls.append("terminate")

    monkeypatch.setattr("bench.learn.subprocess.Popen", Training)
    before = signal.getsignal(signal.SIGINT)
    with pytest.raises(type(ending)):
        _train(TrainingRun("walker-walk", 0, tmp_path, ("--frames", "100")))
    assert calls == ["wait", "terminate", "wait"] and signal.getsignal(signal.SIGINT) == before


def test_check_same_refuses_a_folder_with_other_settings(tmp_path):
    begun = Config(env=EnvConfig(task="walk"), run=RunConfig(frames=100, run_dir=str(tmp_path)))
    dump_config(begun, tmp_path / "config.yaml")
    check_same(begun, tmp_path / "nothing yet")
    check_same(replace(begun, run=replace(begun.run, frames=200)), tmp_path)  # a budget may be extended
    with pytest.raises(UserError, match=r"--planner\.horizon 8, not 7"):
        check_same(replace(begun, planner=PlannerConfig(horizon=7)), tmp_path)
    with pytest.raises(UserError, match=r"--run\.seed"):
        check_same(replace(begun, run=replace(begun.run, seed=1)), tmp_path)
    given = replace(begun, env=replace(begun.env, objective="upright"))
    dump_config(given, tmp_path / "config.yaml")
    with pytest.raises(UserError, match=r"--env\.objective upright, not None"):
        check_same(begun, tmp_path)
    check_same(replace(given, env=replace(given.env, task=None)), tmp_path)  # the default task of the domain


@pytest.mark.parametrize(
    ("flag", "own"), [("--run.seed", "--seeds"), ("--env.task", "--tasks"), ("--run.frames", "--frames")]
)
def test_request_refuses_settings_that_its_own_flags_set(tmp_path, capsys, flag, own):
    assert benchmark.main(["learn", flag, "5", "--out", str(tmp_path / "out")]) == 2
    assert f"{own} sets {flag} here" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_learn_takes_each_task_and_seed_once():
    names = ("walker", "walker-walk", "gymnasium-my_robot:Reach-v0", "walkr")
    request = Request(tasks=names, seeds=(1, 0, 1))
    assert request.tasks == ("walker-walk", "gymnasium-my_robot:Reach-v0", "walkr") and request.seeds == (1, 0)


def test_compare_takes_the_median_of_frames_to_a_threshold():
    curves = [Curve("walker-walk", seed, [Point(frames, 1.0, 700.0)]) for seed, frames in enumerate((20_000, 60_000))]
    assert compare("walker-walk", curves, [600])["latentplan"]["frames_to"] == {"600": 40_000}
    late = [curves[0], Curve("walker-walk", 1, [Point(60_000, 1.0, 0.0)])]
    assert compare("walker-walk", late, [600])["latentplan"]["frames_to"] == {"600": None}


@pytest.mark.parametrize(
    ("name", "text"), [("final.json", "{"), ("final.json", "[]"), ("metrics.csv", "env_frames,planner_return\n80,1\n")]
)
def test_read_run_names_the_folder_when_results_are_damaged(tmp_path, name, text):
    (tmp_path / "metrics.csv").write_text(HEADER + "80,7,4.0,1,2\n")
    (tmp_path / name).write_text(text)
    with pytest.raises(UserError, match="the results in"):
        read_run("walker-walk", 0, tmp_path, "planner")


def test_interquartile_estimate_covers_the_mean_at_its_confidence_level_for_few_runs():
    rng, held = np.random.default_rng(0), 0
    for _ in range(400):
        low, high = interquartile_estimate([rng.normal(size=2), rng.normal(size=3)])[1:]
        held += low <= 0.0 <= high
    assert 0.92 < held / 400 < 1.0
    assert interquartile_estimate([[1.0, 4.0]]) == pytest.approx(mean_estimate([1.0, 4.0]))
    assert interquartile_estimate([[1.0]])[1:] == interquartile_estimate([[1.0, 2.0], [3.0]])[1:] == (None, None)
