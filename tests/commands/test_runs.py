"""Training runs are listed, watched and compared from what their folders hold."""

import csv
import errno
import html
import io
import json
import os
import re
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from latentplan.commands import compare
from latentplan.commands.main import main
from latentplan.config import Config, EnvConfig, PlannerConfig, RunConfig
from latentplan.config.files import dump_config
from latentplan.config.run_folder import lock_folder
from latentplan.config.run_results import find_state, note_state, read_facts, read_progress
from latentplan.evaluation.statistics import confidence_interval
from latentplan.reporting.compare import group_runs, latest_film, mean_curve
from latentplan.reporting.runs import find_runs, read_run
from latentplan.reporting.svg import Labels, Line, plot_lines

COLUMNS = ("env_frames", "updates", "minutes", "planner_return", "actor_return")


@pytest.fixture
def make_run(tmp_path):
    """Makes a folder with the settings and evaluations of a run."""

    def make(name, returns=(100.0, 300.0, 200.0), seed=0, **planner):
        folder = tmp_path / name
        folder.mkdir(parents=True)
        run = RunConfig(frames=4000, seed=seed)
        env = EnvConfig(domain="cartpole", task="swingup")
        dump_config(
            replace(Config(), env=env, run=run, planner=PlannerConfig(**{"horizon": 12, **planner})),
            folder / "config.yaml",
        )
        with (folder / "metrics.csv").open("w", newline="") as file:
            writer = csv.writer(file)
            writer.writerow(COLUMNS)
            for index, value in enumerate(returns, start=1):
                writer.writerow([1000 * index, 10 * index, 0.5 * index, value, value - 50.0])
        return folder

    return make


def test_runs_lists_best_and_last_return_of_every_run_below_a_folder(make_run, tmp_path, capsys):
    make_run("one")
    note_state(make_run("sweep/two", returns=()), "finished")
    assert main(["runs", str(tmp_path)]) == 0
    header, one, two = capsys.readouterr().out.splitlines()
    assert header.split() == ["run", "task", "seed", "frames", "minutes", "best", "last", "state"]
    assert one.split() == ["one", "cartpole-swingup", "0", "3,000", "1.5", "300.0", "200.0", "stopped"]
    assert two.split() == ["sweep/two", "cartpole-swingup", "0", "0", "0.0", "-", "-", "finished"]


def test_runs_gives_one_line_for_each_folder_that_is_no_run(make_run, tmp_path, capsys):
    make_run("good")
    (tmp_path / "empty").mkdir()
    (tmp_path / "foreign" / "deep").mkdir(parents=True)
    (tmp_path / "settings").mkdir()
    (tmp_path / "settings" / "config.yaml").write_text("{{{")
    damaged = make_run("damaged")
    (damaged / "metrics.csv").write_text("a,b\n1,2\n")
    assert main(["runs", str(tmp_path)]) == 0
    output = capsys.readouterr()
    assert len(output.out.splitlines()) == 2
    lines = output.err.splitlines()
    assert len(lines) == 4
    for name, line in zip(("damaged", "empty", "foreign", "settings"), lines, strict=True):
        assert line.startswith("no run: ") and str(tmp_path / name) in line


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("metrics.csv", ",".join(COLUMNS) + '\n1000,10,0.5,"' + "1" * 140_000 + "\n"),
        ("metrics.csv", ",".join(COLUMNS) + "\n1000,10,0.5,7,7\nnan,20,1.0,,\n"),
        ("final.json", json.dumps({"env_frames": "x", "updates": 1, "minutes": 1.0, "planner": 1.0, "actor": 1.0})),
        ("final.json", json.dumps({"env_frames": 9, "updates": 1, "minutes": 1.0, "planner": None, "actor": 1.0})),
        ("final.json", '{"env_frames": 9, "updates": 1e999, "minutes": 1.0, "planner": 1.0, "actor": 1.0}'),
        ("final.json", "[" * 100_000),
    ],
)
def test_damaged_results_of_one_run_are_one_line_beside_the_other_runs(make_run, tmp_path, capsys, name, text):
    good, damaged = make_run("good"), make_run("damaged")
    (damaged / name).write_text(text)
    assert main(["runs", str(tmp_path)]) == 0
    output = capsys.readouterr()
    assert [line.split()[0] for line in output.out.splitlines()] == ["run", "good"]
    assert output.err.startswith(f"no run: the results in {damaged} cannot be read: ") and output.err.count("\n") == 1
    assert main(["compare", str(good), str(damaged)]) == 2
    assert capsys.readouterr().err.count("\n") == 1


@pytest.mark.parametrize("name", ["metrics.csv", "final.json", "status.json", ".lock"])
def test_a_pipe_in_the_folder_of_a_run_makes_no_command_wait(make_run, tmp_path, capsys, name):
    make_run("good")
    odd = make_run("odd")
    (odd / name).unlink(missing_ok=True)
    os.mkfifo(odd / name)
    assert main(["runs", str(tmp_path)]) == 0
    output = capsys.readouterr()
    assert "good" in output.out and output.err.count("\n") == (0 if name in ("status.json", ".lock") else 1)


def test_progress_is_the_largest_clock_of_any_row(tmp_path):
    rows = [(",".join(COLUMNS)), "2000,0,0.7,,", "2000,0,0.2,5,5"]  # an evaluation has the clock of its beginning
    (tmp_path / "metrics.csv").write_text("\n".join(rows) + "\n")
    assert read_progress(tmp_path) == {"env_frames": 2000.0, "minutes": 0.7, "updates": 0.0}
    assert set(read_progress(tmp_path / "none").values()) == {0.0}


@pytest.mark.parametrize("method", ["iterdir", "exists"])
def test_folder_that_may_not_be_read_is_one_line_beside_the_runs(make_run, tmp_path, capsys, monkeypatch, method):
    make_run("good")
    closed = tmp_path / "closed"
    closed.mkdir()
    allowed = getattr(Path, method)

    def refuse(self, *given):  # root may read everything, so the refusal is imitated
        if closed in (self, self.parent):
            raise PermissionError(errno.EACCES, "Permission denied", str(self))
        return allowed(self, *given)

    monkeypatch.setattr(Path, method, refuse)
    assert main(["runs", str(tmp_path)]) == 0
    output = capsys.readouterr()
    assert [line.split()[0] for line in output.out.splitlines()] == ["run", "good"]
    assert output.err == f"no run: {closed} cannot be read: Permission denied\n"


def test_names_that_are_not_utf8_are_printed_as_escapes(make_run, tmp_path, monkeypatch):
    folders, page = [make_run("caf\udce9"), make_run("other", horizon=5)], tmp_path / "page.html"
    for words in (["runs", tmp_path], ["compare", *folders, "--report", page]):
        output = io.TextIOWrapper(io.BytesIO(), encoding="utf-8", errors="strict")
        monkeypatch.setattr(sys, "stdout", output)
        assert main([*map(str, words)]) == 0
        assert (b"caf\\udce9" in output.buffer.getvalue()) == (words[0] == "runs")
    assert "caf\\udce9" in page.read_text()


@pytest.mark.parametrize("command", ["runs", "watch", "compare"])
def test_a_missing_folder_is_refused_in_one_line(command, tmp_path, capsys):
    other = [str(tmp_path)] if command == "compare" else []
    assert main([command, str(tmp_path / "missing"), *other]) == 2
    assert re.fullmatch(r"error: there is no folder .*missing.*\n", capsys.readouterr().err)


def test_a_run_is_running_while_its_lock_is_held_and_has_failed_if_it_was_killed(make_run):
    folder = make_run("run")
    assert find_state(folder) == ("stopped", None)  # a run of a version that noted no state
    with lock_folder(folder):
        note_state(folder, "running", command="train")
        assert find_state(folder) == ("running", None)
    assert find_state(folder) == ("failed", "the process was killed")
    note_state(folder, "failed", reason="no space left")
    assert find_state(folder) == ("failed", "no space left")
    note_state(folder, "stopped")
    assert find_state(folder) == ("stopped", None)
    assert json.loads((folder / "status.json").read_text())["command"] == "train"


def test_asking_for_the_state_does_not_hinder_a_run_that_begins(make_run):
    folder = make_run("run")
    for _ in range(50):
        find_state(folder)
        with lock_folder(folder):
            assert find_state(folder)[0] == "running"


def test_watch_prints_every_evaluation_and_returns_whether_the_run_failed(make_run, capsys):
    folder = make_run("run")
    assert main(["watch", str(folder)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines[1:-1]] == ["1,000", "2,000", "3,000"]
    assert lines[-1].startswith("stopped | 3,000 frames | 1.5 min | best 300.0")
    note_state(folder, "failed", reason="no space left")
    assert main(["watch", str(folder)]) == 1
    assert capsys.readouterr().out.splitlines()[-1].endswith(": no space left")


def test_compare_groups_seeds_and_names_the_settings_that_differ(make_run, tmp_path, capsys):
    folders = [make_run("a0", seed=0), make_run("a1", (200.0, 400.0, 300.0), seed=1), make_run("b", horizon=5)]
    page = tmp_path / "page.html"
    assert main(["compare", *map(str, folders), "--report", str(page)]) == 0
    text = capsys.readouterr().out
    assert re.search(r"^horizon 12 +cartpole-swingup +0, 1 .* 250\.0 \(-?[\d.]+ to [\d.]+\)", text, re.MULTILINE)
    assert re.search(r"^planner\.horizon +12 +5$", text, re.MULTILINE)
    text = page.read_text()
    assert "planner.horizon" in text and "<svg" in text
    assert not re.search(r"""(?:src|href)=["'](?!data:|#)""", text)


def test_watch_refuses_a_period_that_no_clock_can_wait_for(assert_refused, make_run):
    assert_refused(
        ["watch", make_run("run"), "--every", "1e10"], "--every must be in [0.001, 86400], got 10000000000.0"
    )


@pytest.mark.parametrize("name", ["$HOME/x_y_$USER", "_hidden", "\udcff", "$\\frac$"])
def test_figures_show_every_name_as_it_is(name):
    drawn = plot_lines([Line(name, [0.0, 1.0], [1.0, 2.0]), Line("b", [0.0, 1.0], [2.0, 1.0])], Labels("", "x", "y"))
    assert html.escape(name.encode("utf-8", "backslashreplace").decode(), quote=False) in drawn


def test_compare_gives_every_group_a_name_of_its_own(make_run):
    run = read_run(make_run("run"))
    runs = []
    for domain, task in (("walker", "walk"), ("cheetah", "run")):
        for horizon, num_samples in ((8, 64), (12, 64), (12, 128)):
            planner = PlannerConfig(horizon=horizon, num_samples=num_samples, num_elites=8)
            config = replace(run.config, env=EnvConfig(domain=domain, task=task), planner=planner)
            runs.append(replace(run, config=config))
    groups, differ = group_runs(runs)
    assert len(differ) > 2 and len({group.name for group in groups}) == len(groups) == 6
    assert groups[1].name == f"domain walker, horizon 12, num_samples 64 and {len(differ) - 3} more"
    assert [group.name for group in group_runs(runs[:2])[0]] == ["horizon 8", "horizon 12"]


def test_compare_takes_equal_settings_as_one_group_however_they_are_written(make_run):
    runs = [read_run(make_run(str(index), seed=index, deadline_ms=value)) for index, value in enumerate((5, 5.0))]
    assert len(group_runs(runs)[0]) == 1


def test_mean_curve_of_one_seed_is_its_evaluations_and_of_several_their_mean(make_run):
    runs = [read_run(make_run("a", seed=0)), read_run(make_run("b", (200.0, 400.0, 300.0), seed=1))]
    alone = mean_curve(group_runs(runs[:1])[0][0], "planner", "env_frames", confidence_interval)
    assert list(alone.x) == [1000, 2000, 3000] and list(alone.y) == [100, 300, 200] and alone.low is None
    both = mean_curve(group_runs(runs)[0][0], "planner", "env_frames", confidence_interval)
    assert (both.x[0], both.x[-1], both.y[0], both.y[-1]) == (1000, 3000, 150, 250)
    low, high = confidence_interval([200.0, 300.0])
    assert (both.low[-1], both.high[-1]) == pytest.approx((low, high))


def test_a_run_that_two_paths_name_is_compared_once(make_run, tmp_path, capsys):
    one, two = make_run("one"), make_run("two", seed=1)
    (tmp_path / "link").symlink_to(one)
    folders = (one, two, tmp_path / "link", two / ".." / "two")
    assert compare.Request(folders=folders).distinct == (one, two)
    assert main(["compare", *map(str, folders)]) == 0
    twice = capsys.readouterr().out
    assert main(["compare", str(one), str(two)]) == 0
    assert capsys.readouterr().out == twice
    assert main(["compare", str(one), str(tmp_path / "link")]) == 2
    assert "a comparison needs two runs or more" in capsys.readouterr().err


def test_a_run_that_is_compared_alone_is_refused(make_run, capsys):
    folder = str(make_run("run"))
    assert main(["compare", folder, folder]) == 2
    assert capsys.readouterr().err == "error: a comparison needs two runs or more: give their folders\n"


def test_find_runs_takes_a_run_itself(make_run):
    runs, problems = find_runs(make_run("run"))
    assert len(runs) == 1 and not problems


def test_runs_that_repeat_a_seed_are_compared_by_folder(make_run, tmp_path):
    names = ("one/seed0", "one/seed1", "two/seed0", "two/seed1", "two/seed2")
    runs = [read_run(make_run(name, seed=int(name[-1]))) for name in names]
    groups, differ = group_runs(runs)
    assert [[run.folder for run in group.runs] for group in groups] == [
        [tmp_path / name for name in names if name.startswith(folder)] for folder in ("one", "two")
    ]
    assert [group.name for group in groups] == [f"cartpole-swingup in {tmp_path / folder}" for folder in ("one", "two")]
    assert differ == {}
    assert len(group_runs(runs[1:3])[0]) == 1  # two seeds in two folders


def test_compare_refuses_two_runs_of_a_folder_with_the_same_settings_and_seed(make_run, assert_refused):
    one, two = make_run("one"), make_run("two")
    assert_refused(["compare", one, two], f"{one} and {two} have the same settings and the same seed: give one of them")


def test_watch_prints_the_new_final_evaluation_of_a_run_that_goes_on(make_run, monkeypatch, capsys):
    folder = make_run("run", (100.0, 200.0))

    def finish(frames, planner):
        final = {"env_frames": frames, "minutes": 1.0, "updates": frames, "planner": planner, "actor": 0.0}
        (folder / "final.json").write_text(json.dumps(final))

    def go_on(_):
        finish(4000, 777.0)
        note_state(folder, "finished")

    finish(3000, 333.0)
    monkeypatch.setattr("latentplan.config.run_results.is_locked", lambda folder: read_facts(folder) == {})
    monkeypatch.setattr("time.sleep", go_on)
    assert main(["watch", str(folder)]) == 0
    shown = re.findall(r"([\d,]+) frames .*planner +([\d.]+)", capsys.readouterr().out)
    assert shown == [("1,000", "100.0"), ("2,000", "200.0"), ("3,000", "333.0"), ("4,000", "777.0")]


def test_latest_film_of_a_run_that_goes_on_is_not_the_earlier_final_one(make_run):
    folder = make_run("run")  # evaluated last at 3,000 frames
    (folder / "videos").mkdir()
    for name in ("final.webm", "000003000.webm"):
        (folder / "videos" / name).touch()
    for frames, name in ((2000, "000003000.webm"), (3000, "final.webm")):
        (folder / "final.json").write_text(json.dumps({"env_frames": frames}))
        assert latest_film(folder).name == name
