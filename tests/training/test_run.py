"""Whole tiny runs: results, files, repeatability and errors."""

import errno
import shutil
import subprocess
import sys
import warnings
from pathlib import Path

import numpy as np
import pytest
import torch

from latentplan.agents.checkpoint import load_agent, read_info
from latentplan.config import UserError
from latentplan.config.run_folder import lock_folder
from latentplan.config.run_results import find_state, read_evaluations, read_facts
from latentplan.training import resume, train
from latentplan.training.callbacks import COLUMNS
from tests.training.run_folder import list_saves, read_epochs, read_rows, read_state, seal

LOSSES = (
    *(
        "reconstruction",
        "reward",
        "open_loop_reward",
        "continue",
        "dynamics",
        "representation",
        "overshooting",
        "probe",
    ),
    *("actor", "value", "imagined_return", "entropy", "model_grad_norm", "behaviour_grad_norm"),
)


def without_minutes(folder):
    return [{name: value for name, value in row.items() if name != "minutes"} for row in read_rows(folder)]


def test_train_ends_with_its_budget_and_returns_a_summary(finished):
    assert finished.exit_code == 0
    assert finished.summary.keys() >= {"planner", "actor"}
    assert all(0.0 <= finished.summary[mode] <= 20.0 for mode in ("planner", "actor"))
    state = read_state(finished.run_dir)
    assert state["run"]["env_frames"] == state["run"]["decisions"] == 90


def test_train_writes_a_report_and_notes_that_it_has_finished(tiny, dot, tmp_path):
    result = train(tiny(tmp_path / "run", evaluation={"report": True}), dot)
    page = (result.run_dir / "report.html").read_text()
    assert "<h2>Training curves</h2>" in page and "<h2>Imagined against real</h2>" in page
    assert read_facts(result.run_dir)["state"] == "finished"
    assert find_state(result.run_dir) == ("finished", None)


def test_train_makes_every_update_of_its_rounds(finished):
    # 45 decisions before learning, then three rounds of 15; 6 updates per round, and 6 after the last round.
    updates = read_state(finished.run_dir)["learner"]["updates"]
    assert updates == 6 * 4
    assert [int(row["updates"]) for row in read_epochs(finished.run_dir)] == [6, 12, 18, 24]


def test_train_writes_metrics_in_the_documented_order(finished):
    rows, epochs = read_rows(finished.run_dir), read_epochs(finished.run_dir)
    assert tuple(rows[0]) == (*COLUMNS, *LOSSES)
    clocks = [[float(row[name]) for row in epochs] for name in ("env_frames", "decisions", "updates", "minutes")]
    assert all(np.all(np.diff(clock) >= 0) for clock in clocks)
    assert all(np.isfinite(float(row[name])) for row in epochs for name in LOSSES)
    assert any(row["episode_return"] for row in epochs)


def test_train_writes_evaluations_with_the_clocks_of_the_evaluated_weights(finished):
    evaluated = [row for row in read_rows(finished.run_dir) if row["planner_return"]]
    evaluations = read_state(finished.run_dir)["run"]["evaluations"]
    assert len(evaluated) == len(evaluations) > 0
    for row, entry in zip(evaluated, evaluations, strict=True):
        assert (int(row["env_frames"]), int(row["updates"])) == (entry["env_frames"], entry["updates"])
        assert float(row["planner_minus_actor"]) == pytest.approx(entry["planner"] - entry["actor"])


def test_train_saves_agents_that_act(finished):
    info = read_info(finished.run_dir)
    assert info.keys() >= {"domain", "task", "env_frames", "updates", "minutes", "config", "metrics"}
    for name in ("best", "last"):
        action = load_agent(finished.run_dir / "checkpoints" / name).act(np.zeros((64, 64, 3), np.uint8))
        assert action.shape == (1,)


def test_train_repeats_with_its_seed_also_when_another_process_collects(finished, tiny, dot, tmp_path):
    beside = train(tiny(tmp_path / "beside", collection={"overlap": True}), dot)
    assert beside.exit_code == 0
    assert without_minutes(beside.run_dir) == without_minutes(finished.run_dir)
    assert beside.summary == finished.summary


def test_train_differs_with_another_seed(finished, tiny, dot, tmp_path):
    other = train(tiny(tmp_path / "other", run={"seed": 1, "frames": 45}), dot)
    (first, *_), (theirs, *_) = read_epochs(finished.run_dir), read_epochs(other.run_dir)
    assert first["reconstruction"] != theirs["reconstruction"]


def test_train_refuses_folders_in_use(finished, tiny, dot, tmp_path):
    with pytest.raises(UserError, match=r"holds a run: resume it with latentplan.training.resume\(.*another run_dir$"):
        train(tiny(finished.run_dir), dot)
    with pytest.raises(UserError, match="--run-dir must name a folder"):
        train(tiny(""), dot)
    (tmp_path / "agent").mkdir()
    (tmp_path / "agent" / "info.json").touch()
    with pytest.raises(UserError, match="already holds an agent: choose another --run-dir"):
        train(tiny(tmp_path / "agent"), dot)
    with lock_folder(finished.run_dir), pytest.raises(UserError, match="another process learns"):
        resume(finished.run_dir, make_env=dot)
    with lock_folder(tmp_path), pytest.raises(UserError, match="another process learns"):
        train(tiny(tmp_path), dot)
    assert not (tmp_path / "config.yaml").exists()


def test_final_results_are_written_as_a_whole_or_not_at_all(tiny, dot, tmp_path, monkeypatch):
    write = Path.write_text

    def fill_the_disk(path, text, *rest, **options):
        if "final.json" in path.name:
            write(path, text[:20], *rest, **options)
            raise OSError(errno.ENOSPC, "No space left on device", str(path))
        return write(path, text, *rest, **options)

    monkeypatch.setattr(Path, "write_text", fill_the_disk)
    with pytest.raises(UserError, match="has stopped: No space left on device"):
        train(tiny(tmp_path / "run"), dot)
    assert not list((tmp_path / "run").glob("*final.json*"))
    assert read_evaluations(tmp_path / "run")


def test_train_refuses_a_run_without_budget(tiny, dot, tmp_path):
    with pytest.raises(UserError, match="give --frames, --minutes or --updates"):
        train(tiny(tmp_path / "endless", run={"frames": None}), dot)


def test_resume_refuses_an_empty_folder(tmp_path):
    with pytest.raises(UserError, match="nothing to resume"):
        resume(tmp_path)


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        ("state.pt", "no save in .* is whole: .*state.pt is damaged"),
        ("rows.pt", "no save in .* is whole: .*rows.pt is damaged"),
        ("foreign state.pt", "state.pt is damaged"),
        ("foreign rows.pt", "rows.pt is damaged"),
        ("latent_dim", "do not fit the settings in its config.yaml"),
    ],
)
def test_resume_names_damaged_files_in_one_line(damage, message, finished, dot, tmp_path):
    folder = shutil.copytree(finished.run_dir, tmp_path / "run")
    for save in list_saves(folder):
        if damage.startswith("foreign"):
            torch.save({"run": {}}, save / damage.split()[1])
            seal(save)
        elif damage == "latent_dim":
            text = (folder / "config.yaml").read_text()
            (folder / "config.yaml").write_text(text.replace("latent_dim: 32", "latent_dim: 16"))
        else:
            (save / damage).write_bytes((save / damage).read_bytes()[:-200])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with pytest.raises(UserError, match=message) as caught:
            resume(folder, make_env=dot)
    assert "\n" not in str(caught.value)


def test_resume_refuses_other_environments_than_those_of_the_running_episodes(finished, dot, tmp_path):
    folder = shutil.copytree(finished.run_dir, tmp_path / "run")
    text = (folder / "config.yaml").read_text()
    (folder / "config.yaml").write_text(text.replace("num_envs: 1", "num_envs: 2"))
    with pytest.warns(RuntimeWarning, match="num_envs from 1 to 2"):
        with pytest.raises(UserError, match=r"env\.num_envs in .*config\.yaml no longer fit") as caught:
            resume(folder, make_env=dot)
    assert "\n" not in str(caught.value)


def test_resume_asks_for_the_users_environment(finished):
    with pytest.raises(UserError, match="with make_env"):
        resume(finished.run_dir)


@pytest.mark.parametrize("place", ["file", "file/run"])
def test_train_names_a_folder_that_cannot_be_made(place, tiny, dot, tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(UserError, match="cannot make the folder"):
        train(tiny(tmp_path / place), dot)


def test_train_raises_when_a_reward_is_not_finite(tiny, dot, tmp_path):
    class Broken(dot):
        def step(self, action):
            picture, _, terminated, truncated, info = super().step(action)
            return picture, float("nan"), terminated, truncated, info

    with pytest.raises(UserError, match="not finite"):
        train(tiny(tmp_path / "run"), Broken)


def test_train_explains_that_episodes_are_too_short(tiny, dot, tmp_path):
    class Short(dot):
        def step(self, action):
            picture, reward, terminated, _, info = super().step(action)
            return picture, reward, terminated, self.steps == 4, info

    with pytest.raises(UserError, match=r"sequence_length \(5\)"):
        train(tiny(tmp_path / "run"), Short)


def test_train_shortens_the_prefill_to_a_small_budget(tiny, dot, tmp_path):
    run = train(tiny(tmp_path / "run", run={"frames": 25}), dot)
    assert read_state(run.run_dir)["run"]["env_frames"] == 25


def test_train_and_load_agent_leave_torchs_stream_and_threads(tiny, dot, tmp_path):
    stream, threads = torch.get_rng_state(), torch.get_num_threads()
    try:
        train(tiny(tmp_path / "run", run={"threads": threads + 1}), dot)
        assert torch.get_num_threads() == threads
        load_agent(tmp_path / "run")
        assert torch.equal(torch.get_rng_state(), stream)
    finally:
        torch.set_num_threads(threads)


def test_train_refuses_a_folder_whose_name_is_not_utf8(tiny, dot, tmp_path):
    for changes in ({}, {"collection": {"keep_episodes": str(tmp_path / "\udcff")}}):
        with pytest.raises(UserError, match="must be UTF-8"):
            train(tiny(tmp_path / ("run" if changes else "\udcff"), **changes), dot)
    assert list(tmp_path.iterdir()) == []


def test_display_goes_silent_when_nobody_reads_it():
    code = (
        "import sys; from latentplan.training.console import StatusLine; console = StatusLine().console\n"
        "for _ in range(2000): console.print('x' * 100)\n"
        "print('more'); print('done', file=sys.stderr)"
    )
    process = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    process.stdout.close()
    complaint = process.stderr.read()
    assert (process.wait(), complaint) == (0, b"done\n")
