"""`benchmark.py suite`: rows of results, their statistics, and the report."""

import re
from urllib.parse import unquote

import benchmark
import numpy as np
import pytest
from bench.estimates import interquartile_mean
from bench.suite_report import write_report
from bench.suite_rows import Origin, Row, merge_rows, note_origin, read_origin, read_rows, write_rows
from bench.suite_scores import (
    aggregate,
    completed,
    counted,
    improvement,
    newest_curves,
    profile,
    rows_at,
    score_matrix,
)
from hypothesis import given
from hypothesis import strategies as st

TASKS = ("walker-walk", "cartpole-swingup", "ball_in_cup-catch")


def make_row(task="walker-walk", seed=0, env_frames=100_000, planner=500.0, actor=400.0, version="0.2.0", minutes=60.0):
    return Row(task, seed, env_frames, minutes, planner, actor, env_frames // 4, "2 cores of X", "abc", version)


ROWS = st.lists(
    st.builds(
        make_row,
        task=st.sampled_from(TASKS),
        seed=st.integers(0, 2),
        env_frames=st.integers(1, 4).map(lambda count: 25_000 * count),
        planner=st.floats(0.0, 1000.0).map(lambda value: round(value, 2)),
        version=st.sampled_from(("0.2.0", "0.10.0")),
    ),
    unique_by=lambda row: (row.task, row.seed, row.version, row.env_frames),
)


@given(known=ROWS, new=ROWS)
def test_merge_keeps_other_runs_and_replaces_those_of_a_task_seed_and_version(known, new):
    merged = merge_rows(known, new)
    replaced = {(row.task, row.seed, row.version) for row in new}
    kept = [row for row in known if (row.task, row.seed, row.version) not in replaced]
    assert sorted(merged) == sorted([*kept, *new])
    assert merge_rows(merged, new) == merged == merge_rows(merged, []) == merge_rows([], merged)


@given(rows=ROWS)
def test_rows_return_unchanged_from_their_file(tmp_path_factory, rows):
    path = tmp_path_factory.mktemp("rows") / "rows.csv"
    write_rows(path, rows)
    assert read_rows(path) == rows and path.exists() == bool(rows)


def test_merge_adds_a_sweep_to_a_file_that_need_not_exist(tmp_path, capsys):
    results, out = tmp_path / "suite.csv", tmp_path / "out"
    out.mkdir()
    other, old, new = make_row("fish-swim"), make_row(planner=1.0), make_row(planner=2.0)
    for rows, expected in (([other, old], [other, old]), ([new], [other, new])):
        write_rows(out / "results.csv", rows)
        assert benchmark.main(["suite", "--results", str(results), "--merge", str(out)]) == 0
        assert read_rows(results) == expected
    assert results.read_text().splitlines()[0] == (
        "task,seed,env_frames,minutes,planner,actor,updates,hardware,commit,version"
    )


def test_merge_adds_only_the_tasks_and_seeds_that_were_asked_for(tmp_path, capsys):
    results = tmp_path / "suite.csv"
    write_rows(tmp_path / "results.csv", [make_row(task, seed) for task in TASKS for seed in (0, 1)])
    flags = ["--results", str(results), "--merge", str(tmp_path), "--tasks", TASKS[1], "--seeds"]
    assert benchmark.main(["suite", *flags, "1"]) == 0
    assert read_rows(results) == [make_row(TASKS[1], 1)]
    assert benchmark.main(["suite", *flags, "7"]) == 2
    assert "holds no rows of these --tasks and --seeds" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("old", "new", "named"),
    [
        ("planner", "plan", "lacks the column planner"),
        ("100000", "many", "line 2"),
        ("500.0", "nan", "line 2"),
        ("walker-walk", "", "line 2"),
        (",0.2.0", "", "line 2"),
    ],
)
def test_damaged_file_of_results_is_refused_in_one_line(tmp_path, capsys, old, new, named):
    path = tmp_path / "rows.csv"
    write_rows(path, [make_row()])
    path.write_text(path.read_text().replace(old, new))
    assert benchmark.main(["suite", "--results", str(path), "--report", str(tmp_path / "report.md")]) == 2
    assert named in capsys.readouterr().err


def test_origin_names_every_machine_and_commit_and_the_version_that_began(tmp_path):
    assert read_origin(tmp_path) is None
    for hardware, commit, version in (("A", "1", "0.2.0"), ("A", "2", "0.3.0"), ("B", "1", "0.3.0")):
        note_origin(tmp_path, Origin(hardware, commit, version))
    assert read_origin(tmp_path) == Origin("A + B", "1 + 2", "0.2.0")


def test_rows_at_a_number_of_frames_are_the_last_within_them_of_the_newest_version():
    rows = [make_row(env_frames=frames) for frames in (50_000, 100_800, 150_000)]
    rows += [make_row(env_frames=60_000, version="0.1.9"), make_row(seed=1, env_frames=60_000, version="0.10.0")]
    found = rows_at(newest_curves(rows), 100_000)
    assert found == {"walker-walk": {0: rows[1], 1: rows[4]}}
    assert completed(found, 100_000) == {"walker-walk": [rows[1]]}


def test_improvement_agrees_with_rliable_and_is_fair():
    from rliable.metrics import probability_of_improvement

    rng = np.random.default_rng(0)
    ours, theirs = rng.integers(0, 9, (4, 6)) / 9, rng.integers(0, 9, (3, 6)) / 9
    forward, backward = improvement(ours, theirs), improvement(theirs, ours)
    assert forward.mean == pytest.approx(probability_of_improvement(ours, theirs))
    assert forward.mean + backward.mean == pytest.approx(1.0) and improvement(ours, ours).mean == pytest.approx(0.5)
    assert forward.low <= forward.mean <= forward.high
    assert improvement(ours[:1], theirs).low is None


def test_aggregate_is_repeatable_and_has_intervals_from_two_runs_on():
    scores = np.random.default_rng(1).uniform(size=(3, 8))
    found = aggregate(scores)
    assert found == aggregate(scores)
    assert found["interquartile mean"].mean == pytest.approx(interquartile_mean(scores.ravel().tolist()))
    mean, low, high = found["mean"]
    assert mean == pytest.approx(scores.mean()) and low < mean < high
    assert all(each.low is None for each in aggregate(scores[:1]).values())
    share, low, high = profile(scores, np.array([-0.1, 0.5, 1.0]))
    assert share == pytest.approx([1.0, np.mean(scores > 0.5), 0.0]) and (low <= share).all() and (share <= high).all()


def test_report_needs_nothing_but_a_file_of_results(tmp_path, capsys):
    rows = [
        make_row(task, seed, frames, planner=frames / 200 + 10 * seed, actor=frames / 250)
        for task in (*TASKS, "fish-swim")
        for seed in (0, 1)
        for frames in (50_000, 100_000, 150_000)
    ]
    rows.append(make_row("cheetah-run", 0, 50_000))
    write_rows(tmp_path / "suite.csv", rows)
    report = tmp_path / "suite.md"
    assert benchmark.main(["suite", "--results", str(tmp_path / "suite.csv"), "--report", str(report)]) == 0
    text = report.read_text()
    lines = {line.split(" | ")[0].strip("| "): line for line in text.splitlines() if line.startswith("| ")}
    assert "| 505 (441 to 569) | 400 (400 to 400) | 60 | 625 / 874 |" in lines["walker-walk"]
    assert "| 505 (441 to 569) |" in lines["fish-swim"]  # of which nothing is published
    assert "| 50,000 | 1 | **500** | 400 | 60 |" in lines["cheetah-run"]  # EfficientZero V2 has 463
    assert "cheetah-run, seed 0 (50,000)" in text
    assert lines["mean"].startswith("| mean | 505 (")
    assert re.match(r"\| DreamerV3 \| 3 \| 505 / 6\d\d \|", lines["DreamerV3"])
    for kind in ("curves", "profile"):
        assert f"(suite-{kind}.png)" in text and (tmp_path / f"suite-{kind}.png").stat().st_size > 10_000
    flags = ["--results", str(tmp_path / "suite.csv"), "--tasks", "fish-swim", "--seeds", "1"]
    assert benchmark.main(["suite", *flags, "--report", str(report)]) == 0
    assert "1 runs of 1 tasks" in report.read_text() and "walker" not in report.read_text()
    assert benchmark.main(["suite", *flags, "--frames", "20", "--report", str(report)]) == 2
    assert "no run has an evaluation within 20 frames" in capsys.readouterr().err


def test_report_takes_the_mean_of_a_tasks_runs_where_another_task_has_one_run(tmp_path):
    rows = [make_row("walker-walk", seed, planner=400.0 + 200.0 * seed) for seed in (0, 1)]
    rows.append(make_row("fish-swim", planner=100.0))
    write_report(rows, 100_000, tmp_path / "report.md")
    together = (tmp_path / "report.md").read_text().partition("## All tasks together")[2]
    assert "Each task counts once, by the mean of its runs where it has several (tasks: 1); without a" in together
    assert "\n| mean | 300 |" in together and "\n| DreamerV3 | 1 | 500 / 625 |" in together
    assert not re.search(r"\d \(\d", together)


def test_report_takes_as_many_runs_of_each_task_as_the_fewest_where_all_have_several(tmp_path):
    counts = {"walker-walk": 3, "fish-swim": 2}
    rows = [make_row(task, seed, planner=100.0 * seed) for task, count in counts.items() for seed in range(count)]
    write_report(rows, 100_000, tmp_path / "report.md")
    together = (tmp_path / "report.md").read_text().partition("## All tasks together")[2]
    assert "2 runs per task count" in together and "\n| mean | 50 (" in together


def test_a_run_counts_by_its_own_return_where_tasks_have_unequal_numbers_of_runs():
    rows = {"a": [make_row(planner=564.0), make_row(seed=1, planner=788.0)], "b": [make_row(planner=900.0)]}
    scores = score_matrix(counted(rows), ["a", "b"], "planner")
    assert improvement(scores, np.array([[0.625, 0.8]])) == (0.75, None, None)
    assert profile(scores, np.array([0.0, 0.6, 0.8]))[0].tolist() == [1.0, 0.75, 0.5]
    assert aggregate(scores)["mean"].mean == pytest.approx((0.676 + 0.9) / 2)


def test_report_links_its_pictures_whatever_its_name(tmp_path):
    write_report([make_row()], 100_000, tmp_path / "ä (b c).md")
    links = re.findall(r"!\[[^]]*\]\(([^() ]+)\)", (tmp_path / "ä (b c).md").read_text())
    assert {unquote(link) for link in links} == {"ä (b c)-curves.png", "ä (b c)-profile.png"}
