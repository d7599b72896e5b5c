"""`benchmark.py suite`: the queue of runs, its interruptions and its progress."""

import csv
import json
import math
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import benchmark
import pytest
from bench import runs, suite, suite_progress, suite_queue
from bench.anchors import TASK_GROUPS
from bench.runs import TrainingRun
from bench.suite_progress import Board, Progress, estimate_minutes_left, format_left, measure_progress
from bench.suite_rows import Origin, read_origin, read_rows

from latentplan.commands.flags import read_request
from latentplan.config import extras
from latentplan.config.run_folder import lock_folder
from latentplan.config.run_results import read_evaluations

STUB = Path(__file__).with_name("stub_trainer.py")
TASKS = ("walker-walk", "cartpole-swingup", "ball_in_cup-catch")
FRAMES = 100
DRIVER = f"""
import sys
from pathlib import Path
import benchmark
from bench import runs, suite_progress, suite_queue
runs.SCRIPT, suite_queue.POLL_S, suite_progress.LOOK_S = Path({str(STUB)!r}), 0.02, 0.05
sys.exit(benchmark.main(sys.argv[1:]))
"""


@pytest.fixture(autouse=True)
def _stub(monkeypatch):
    monkeypatch.setattr(runs, "SCRIPT", STUB)
    monkeypatch.setattr(suite_queue, "POLL_S", 0.02)
    monkeypatch.setattr(suite_progress, "LOOK_S", 0.05)


def words(out, *flags, tasks=TASKS, seeds=(0, 1), frames=FRAMES):
    given = ["--tasks", ",".join(tasks), "--seeds", *seeds, "--frames", frames, "--jobs", 2, "--out", out, *flags]
    return ["suite", *map(str, given)]


def sweep(out, *flags, **changes):
    return benchmark.main(words(out, *flags, **changes))


def start(root, out, **changes):
    """Starts a sweep as a process of its own."""
    environment = {**os.environ, "PYTHONPATH": f"{root}:{root / 'scripts'}"}
    command = [sys.executable, "-c", DRIVER, *words(out, **changes)]
    return subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)


def processes(out):
    """The processes that each run has had, by run: the flag of each process and its number."""
    found = {}
    for path in out.glob("*/processes.txt"):
        found[path.parent.name] = [line.split() for line in path.read_text().splitlines()]
    return found


def saves(out):
    """The saves that runs can go on from."""
    return list(out.glob("*/resume/save-000001/frames"))


def wait_for(condition, seconds=60.0):
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.01)


def results_of(out):
    """The rows of a sweep without the origin of its runs."""
    return [row[:7] for row in read_rows(out / "results.csv")]


def test_runs_begin_with_the_first_seed_of_every_task(tmp_path):
    order = [(run.task, run.seed) for run in suite.Request(tasks=("dev", *TASKS), seeds=(3, 1), out=tmp_path).runs]
    tasks = TASK_GROUPS["dev"]  # TASKS are among them
    assert order == [(task, seed) for seed in (3, 1) for task in tasks]
    assert len(suite.Request().runs) == 2 * len(TASK_GROUPS["dmc20"])
    assert [run.task for run in suite.Request(tasks=("walker", "walker-run"), seeds=(0,)).runs] == [
        "walker-walk",
        "walker-run",
    ]


@pytest.mark.parametrize("seeds", [("0", "00"), ("[0, 0]",)])
def test_runs_have_each_seed_once(tmp_path, seeds):
    request = read_request(suite.Request, words(tmp_path, tasks=TASKS[:1], seeds=seeds)[1:])
    assert [run.seed for run in request.runs] == [0]


def test_every_task_of_dmc20_has_settings():
    for run in suite.Request(tasks=("dmc20",), seeds=(0,)).runs:
        env = run.resolve().env
        assert f"{env.domain}-{env.task}" == run.task


def test_runs_get_one_thread_each_where_they_fill_the_cores(monkeypatch):
    monkeypatch.setattr(suite, "count_cores", lambda: 2)
    one, two = (suite.Request(jobs=jobs).runs[0].extra for jobs in (1, 2))
    assert one == () and two == ("--run.threads", "1")
    assert suite.Request(jobs=2, settings={"run": {"threads": 3}}).runs[0].extra == ("--run.threads", "3")


def test_sweep_passes_preset_config_and_settings_to_each_run(tmp_path):
    (tmp_path / "own.yaml").write_text("planner: {horizon: 7}\n")
    flags = ["--minutes", "9", "--config", str(tmp_path / "own.yaml"), "--learning.batch_size", "5", "--preset", "cpu"]
    request = read_request(suite.Request, words(tmp_path, *flags)[1:])
    for run in request.runs:
        config = run.resolve()
        assert (config.planner.horizon, config.learning.batch_size) == (7, 5)
        assert (config.run.frames, config.run.minutes, config.run.seed) == (FRAMES, 9.0, run.seed)


def test_resumed_run_keeps_a_limit_of_updates(tmp_path):
    request = read_request(suite.Request, words(tmp_path, "--run.updates", "40")[1:])
    run = request.runs[0]
    assert (run.resolve().run.frames, run.resolve().run.updates) == (FRAMES, 40)
    (run.folder / "resume" / "save-000001").mkdir(parents=True)
    assert run.command()[2:] == ["--resume", str(run.folder), "--frames", str(FRAMES), "--updates", "40"]
    assert run.limits == {"--frames": FRAMES, "--updates": 40}


def test_sweep_runs_everything_once_and_writes_a_row_per_evaluation(tmp_path, capsys):
    assert sweep(tmp_path) == 0
    first = processes(tmp_path)
    assert {name: [flag for flag, _ in each] for name, each in first.items()} == {
        f"{task}-seed{seed}": ["--domain"] for task in TASKS for seed in (0, 1)
    }
    rows = read_rows(tmp_path / "results.csv")
    assert rows == sorted(rows) and len(rows) == len(TASKS) * 2 * FRAMES / 20
    assert {(row.planner, row.actor) for row in rows if row.env_frames == FRAMES} == {(7.0, 5.0)}  # of the final ones
    assert all("2 runs side by side" in row.hardware and row.commit and row.version for row in rows)
    assert sweep(tmp_path) == 0  # the same again starts nothing
    assert sweep(tmp_path, frames=FRAMES - 20) == 0  # and so does less
    assert processes(tmp_path) == first and read_rows(tmp_path / "results.csv") == rows
    assert "6 of 6 runs finished, 100.0% of the work" in capsys.readouterr().out


def test_extended_sweep_keeps_the_final_evaluations_of_its_shorter_runs(tmp_path):
    for frames in (FRAMES, 2 * FRAMES, 3 * FRAMES):
        assert sweep(tmp_path, tasks=TASKS[:1], seeds=(0,), frames=frames) == 0
    rows = {row.env_frames: (row.planner, row.actor) for row in read_rows(tmp_path / "results.csv")}
    assert list(rows) == list(range(20, 3 * FRAMES + 1, 20))
    assert [frames for frames, returns in rows.items() if returns == (7.0, 5.0)] == [100, 200, 300]


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM, signal.SIGINT], ids=lambda number: number.name)
def test_interrupted_sweep_goes_on_and_ends_like_one_that_was_not(root, tmp_path, number):
    whole, cut = tmp_path / "whole", tmp_path / "cut"
    changes = {"tasks": TASKS[:2], "frames": 400}
    assert sweep(whole, **changes) == 0
    cut.mkdir()
    held = [cut / f"{task}-seed1.held" for task in TASKS[:2]]
    for path in held:
        path.touch()
    first = start(root, cut, **changes)
    # A run that is killed before its first save begins again, so all four must have saved themselves.
    wait_for(lambda: len(list(cut.glob("*/final.json"))) == 2 and len(saves(cut)) == 4)
    os.kill(first.pid, number)
    first.communicate(timeout=60)
    assert first.returncode == (-number if number == signal.SIGKILL else 128 + number)
    if number == signal.SIGKILL:  # the runs are told too, and save themselves
        numbers = [int(number) for each in processes(cut).values() for _, number in each]
        wait_for(lambda: not any(is_running(number) for number in numbers))
    for path in held:
        path.unlink()
    assert sweep(cut, **changes) == 0
    flags = [[flag for flag, _ in each] for each in processes(cut).values()]
    assert all(each[0] == "--domain" and set(each[1:]) <= {"--resume"} for each in flags)
    assert sorted(len(each) for each in flags) == [1, 1, 2, 2]  # finished runs were not repeated
    assert results_of(cut) == results_of(whole)


def is_running(number):
    """Whether there is a process that has not ended."""
    try:
        return Path(f"/proc/{number}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def test_runs_that_are_killed_with_their_sweep_go_on(root, tmp_path):
    first = start(root, tmp_path, tasks=TASKS[:1], frames=400)
    wait_for(lambda: len(saves(tmp_path)) == 2)
    first.kill()
    for each in processes(tmp_path).values():
        os.kill(int(each[0][1]), signal.SIGKILL)
    first.communicate(timeout=60)
    assert sweep(tmp_path, tasks=TASKS[:1], frames=400) == 0
    assert all([flag for flag, _ in each] == ["--domain", "--resume"] for each in processes(tmp_path).values())


def test_second_sweep_in_a_folder_is_refused_in_one_line(tmp_path, capsys):
    with lock_folder(tmp_path):
        assert sweep(tmp_path) == 2
    captured = capsys.readouterr()
    assert captured.err.count("\n") == 1 and f"another sweep runs in {tmp_path}" in captured.err
    assert not processes(tmp_path)


def test_failed_run_is_reported_and_tried_again_and_stops_no_other(tmp_path, capsys):
    broken = tmp_path / "walker-walk-seed0.broken"
    broken.touch()
    assert sweep(tmp_path) == 1
    printed = capsys.readouterr().out
    assert "walker-walk, seed 0: failed, exit code 2: error: this run is broken" in printed
    assert "runs that failed: 1;" in printed and "5 of 6 runs finished, 1 failed" in printed
    broken.unlink()
    before = processes(tmp_path)
    assert sweep(tmp_path) == 0
    after = processes(tmp_path)
    assert set(after) - set(before) == {"walker-walk-seed0"} and before.items() <= after.items()


def test_run_whose_folder_cannot_be_prepared_stops_no_other(tmp_path, capsys):
    (tmp_path / "walker-walk-seed0" / "train.log").mkdir(parents=True)
    (tmp_path / "cartpole-swingup-seed0" / "origin.json").mkdir(parents=True)
    assert sweep(tmp_path) == 1
    printed = capsys.readouterr().out
    assert "walker-walk, seed 0: failed, [Errno 21] Is a directory" in printed
    assert re.search("cartpole-swingup, seed 0: failed, .*origin.json could not be written", printed)
    assert "4 of 6 runs finished, 2 failed" in printed


def test_run_waits_while_another_process_has_its_folder(tmp_path, capsys, monkeypatch):
    folder = tmp_path / "walker-walk-seed0"
    code = f"import sys; sys.path.insert(0, {str(STUB.parents[2])!r})\n"
    code += "from pathlib import Path; from latentplan.config.run_folder import lock_folder\n"
    code += f"with lock_folder(Path({str(folder)!r})): print('held', flush=True); sys.stdin.read()"
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
    with subprocess.Popen([sys.executable, "-c", code], **pipes, text=True) as other:
        assert other.stdout.readline() == "held\n"
        wait = Board.wait

        def wait_and_release(board, run):
            wait(board, run)
            other.stdin.close()

        monkeypatch.setattr(Board, "wait", wait_and_release)
        assert sweep(tmp_path) == 0
    printed = capsys.readouterr().out
    assert printed.count("walker-walk, seed 0: waits") == 1 and "6 of 6 runs finished" in printed


@pytest.mark.parametrize(
    ("flags", "named"),
    [
        (["--tasks", "walkr-walk"], "'walker'"),
        (["--tasks", "walker-wlk"], "'walk'"),
        (["--tasks", "dmc21"], "dmc20, dev"),
        (["--tasks", "walker-walk", "--seeds", "0", "-1"], "--seeds"),
        (["--seeds", "0", "x"], "--seeds"),
        (["--jobs", "0"], "--jobs"),
        (["--frames", "0"], "--frames"),
        (["--minutes", "nan"], "--minutes"),
        (["--run.seed", "3"], "--seeds"),
        (["--learning.batch_size", "0"], "batch_size"),
        (["--planner.num_samples", "1e12"], "num_samples"),
        (["--report", "report.txt"], "--report"),
        (["--report", "no/such/folder/report.md"], "no/such/folder"),
        (["--merge", "."], "--results"),
        (["--results", "rows.csv"], "--report"),
        (["--results", "rows.csv", "--report", "report.md", "--jobs", "4"], "--jobs has no effect with --results"),
        (
            ["--results", "rows.csv", "--merge", ".", "--learning.batch_size", "8"],
            "--learning.batch_size has no effect",
        ),
        (["--results", "rows.csv", "--report", "report.md"], "rows.csv holds no rows"),
        (["--results", "rows.csv", "--merge", "nowhere"], "nowhere/results.csv holds no rows"),
        (["--config", "nowhere.yaml"], "nowhere.yaml"),
    ],
)
def test_suite_refuses_bad_input_in_one_line_before_anything_starts(tmp_path, monkeypatch, capsys, flags, named):
    monkeypatch.chdir(tmp_path)
    assert benchmark.main(["suite", "--out", "out", *flags]) == 2
    captured = capsys.readouterr()
    assert captured.out == "" and captured.err.count("\n") == 1 and named in captured.err
    assert not list(tmp_path.iterdir())


def test_missing_rliable_is_one_line_before_anything_starts(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "rliable", None)
    assert sweep(tmp_path / "out", "--report", tmp_path / "report.md") == 2
    line = "error: --report needs rliable, which is not installed; run: pip install 'latentplan[bench]'\n"
    assert capsys.readouterr().err == line and not (tmp_path / "out").exists()


def test_evaluations_of_an_extended_run_keep_those_after_its_former_end(tmp_path):
    lines = [
        "env_frames,updates,minutes,planner_return,actor_return",
        "20,5,1,1,2",
        "40,9,2,3,4",
        "60,12,3,5,6",
        "80,15",
    ]
    (tmp_path / "metrics.csv").write_text("\n".join(lines))  # the last line is still being written
    final = {"env_frames": 40, "updates": 9, "minutes": 2.0, "planner": 7.0, "actor": 8.0}
    (tmp_path / "final.json").write_text(json.dumps(final))
    assert [(each.env_frames, each.planner) for each in read_evaluations(tmp_path)] == [(20, 1.0), (40, 7.0), (60, 5.0)]


def test_finished_run_with_damaged_results_is_named(tmp_path, capsys):
    assert sweep(tmp_path) == 0
    (tmp_path / "walker-walk-seed0" / "final.json").write_text("{")
    assert sweep(tmp_path) == 0
    assert "walker-walk, seed 0: the results in" in capsys.readouterr().out
    assert len({(row.task, row.seed) for row in read_rows(tmp_path / "results.csv")}) == 6  # known rows stay


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_run_with_an_evaluation_that_is_not_finite_is_named_and_adds_no_row(tmp_path, capsys, value):
    assert sweep(tmp_path, tasks=TASKS[:1]) == 0
    path = tmp_path / "walker-walk-seed0" / "final.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"planner": value}))
    (tmp_path / "results.csv").unlink()
    for _ in range(2):  # the second start reads what the first has written
        assert sweep(tmp_path, tasks=TASKS[:1]) == 0
        assert "walker-walk, seed 0: the evaluation at 100 frames in" in capsys.readouterr().out
    assert {row.seed for row in read_rows(tmp_path / "results.csv")} == {1}


def test_time_left_counts_what_is_left_over_the_runs_side_by_side(tmp_path):
    some = [TrainingRun("walker-walk", seed, tmp_path / str(seed), ("--frames", "100")) for seed in range(4)]
    assert estimate_minutes_left(dict.fromkeys(some, Progress(0.0, 0.0)), 2) is None
    progress = {some[0]: Progress(1.0, 60.0), some[1]: Progress(0.5, 30.0), **dict.fromkeys(some[2:], Progress(0, 0))}
    assert estimate_minutes_left(progress, 1) == pytest.approx(30.0 + 60.0 + 60.0)
    assert estimate_minutes_left(progress, 2) == pytest.approx(30.0 + 60.0)
    assert estimate_minutes_left(dict.fromkeys(some, Progress(1.0, 60.0)), 2) == 0.0
    slow = TrainingRun("fish-swim", 0, tmp_path, ("--frames", "100"))
    known = progress | {slow: Progress(0.5, 300.0)}  # a slow run of another domain does not slow the walker's
    assert estimate_minutes_left(known, 1) == pytest.approx(150.0 + 300.0)
    assert [format_left(minutes) for minutes in (0.4, 61.0, 3000.0)] == [
        "about 0 min left",
        "about 1 h 1 min left",
        "about 2 d 2 h left",
    ]


def test_progress_is_that_of_the_largest_clocks(tmp_path):
    run = TrainingRun("walker-walk", 0, tmp_path, ("--frames", "100", "--updates", "1000"))
    assert measure_progress(run) == Progress(0.0, 0.0)
    rows = "2,125,0.8,\n2,0,0.1,9\n"  # of the evaluation before the first update, which takes its time
    (tmp_path / "metrics.csv").write_text("env_frames,updates,minutes,planner_return\n" + rows)
    assert measure_progress(run) == Progress(0.125, 0.8)
    assert estimate_minutes_left({run: Progress(0.02, 0.1)}, 1) is None  # before the first update


def test_state_of_the_sweep_is_printed_now_and_then_without_a_terminal(tmp_path, monkeypatch, capsys):
    run = TrainingRun("walker-walk", 0, tmp_path, ("--frames", "100"))
    monkeypatch.setattr(suite_progress, "LOOK_S", 0.0)
    board = Board([run], 1, tmp_path / "results.csv", None)
    board.look([run])
    assert capsys.readouterr().out == ""
    monkeypatch.setattr(suite_progress, "STATUS_S", 0.0)
    board.look([run])
    assert "0 of 1 runs finished" in capsys.readouterr().out


def test_rows_that_arrive_within_one_tick_of_the_file_systems_clock_are_taken(tmp_path, monkeypatch):
    run = TrainingRun("walker-walk", 0, tmp_path / "run", ("--frames", "100"))
    monkeypatch.setattr(suite_progress, "LOOK_S", 0.0)
    board = Board([run], 1, tmp_path / "results.csv", Origin("cpu", "abc", "1.0"))
    board.begin(run)
    metrics = run.folder / "metrics.csv"
    metrics.write_text("env_frames,updates,minutes,planner_return,actor_return\n20,1,0.1,3,2\n")
    board.look([run])
    before = metrics.stat().st_mtime_ns
    with metrics.open("a") as file:
        file.write("40,2,0.2,5,4\n")
    os.utime(metrics, ns=(before, before))
    board.finish(run)
    assert [row.planner for row in read_rows(tmp_path / "results.csv")] == [3.0, 5.0]


def test_sweep_without_results_ends_with_a_note_in_place_of_its_report(tmp_path, capsys):
    (tmp_path / "walker-walk-seed0.broken").touch()
    assert sweep(tmp_path, "--report", tmp_path / "report.md", tasks=TASKS[:1], seeds=(0,)) == 1
    captured = capsys.readouterr()
    assert "no report: no run has an evaluation within 100 frames" in captured.out and captured.err == ""
    assert not (tmp_path / "report.md").exists()


def test_sweep_ends_with_its_report(tmp_path):
    out = tmp_path / "out"
    assert sweep(out, "--report", tmp_path / "report.md", tasks=TASKS[:1], seeds=(0,)) == 0
    assert "walker-walk" in (tmp_path / "report.md").read_text()
    assert len(list(csv.DictReader((out / "results.csv").open()))) == FRAMES / 20


def test_run_is_finished_with_its_budget_or_a_larger_one(tmp_path):
    run = TrainingRun("walker-walk", 0, tmp_path, ("--frames", "100"))
    assert not run.is_finished()
    run.mark_finished()
    for budget, finished in ((("--frames", "1e2"), True), (("--frames", "101"), False), (("--minutes", "1"), False)):
        assert TrainingRun("walker-walk", 0, tmp_path, budget).is_finished() == finished
    (tmp_path / "finished.json").write_text("{")
    assert not run.is_finished()


def test_sweep_refuses_a_ray_address_without_ray_and_says_what_to_install(tmp_path, capsys, monkeypatch):
    assert sweep(tmp_path, "--ray-address", "10.0.0.1:6379") == 2
    assert "--ray-address has no effect here: give --backend ray too" in capsys.readouterr().err
    found = extras.util.find_spec
    monkeypatch.setattr(extras.util, "find_spec", lambda name: None if name == "ray" else found(name))
    assert sweep(tmp_path, "--backend", "ray") == 2
    assert (
        "--backend ray needs ray, which is not installed; run: pip install 'latentplan[ray]'" in capsys.readouterr().err
    )


@pytest.mark.slow
def test_sweep_on_a_cluster_has_the_rows_of_one_on_this_machine(tmp_path, root):
    pytest.importorskip("ray")
    out = tmp_path / "ray"
    assert sweep(tmp_path / "process", seeds=(0,)) == 0
    environment = {**os.environ, "PYTHONPATH": f"{root}:{root / 'scripts'}"}
    command = [sys.executable, "-c", DRIVER, *words(out, "--backend", "ray", tasks=TASKS, seeds=(0,))]
    broken = Path(f"{out / 'walker-walk-seed0'}.broken")
    out.mkdir()
    broken.touch()
    first = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert (
        first.returncode == 1 and "walker-walk, seed 0: failed, exit code 2: error: this run is broken" in first.stdout
    )
    broken.unlink()
    second = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert second.returncode == 0, second.stdout + second.stderr
    assert results_of(out) == results_of(tmp_path / "process")
    assert all(len(started) == 1 for name, started in processes(out).items())
    assert " + " not in read_origin(out / "cartpole-swingup-seed0").hardware
