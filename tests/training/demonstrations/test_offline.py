"""Runs that start with recorded episodes, with and without collection of their own."""

import shutil
from dataclasses import replace

import numpy as np
import pytest
import torch

from latentplan.commands.main import main
from latentplan.config import ReplayConfig, UserError
from latentplan.config.files import dump_config, read_config
from latentplan.config.run_results import read_evaluations
from latentplan.replay.disk import count_saved
from latentplan.training import resume, saving, train
from latentplan.training.callbacks import Collect
from latentplan.training.collection import keeping
from latentplan.training.collection.keeping import check_kept
from latentplan.training.demonstrations.fitting import FittedRecording
from latentplan.training.demonstrations.opening import open_recordings
from tests.training.demonstrations.recorded import target, write_minari
from tests.training.run_folder import fingerprint, list_saves, read_epochs, read_rows, read_state


@pytest.fixture(scope="module")
def kept(tiny, dot, tmp_path_factory):
    """A run that kept its episodes, and their folder."""
    folder = tmp_path_factory.mktemp("kept")
    train(tiny(folder / "run", collection={"keep_episodes": str(folder / "episodes")}), dot)
    return folder / "run", folder / "episodes"


def offline(tiny, folder, episodes, updates=18, **changes):
    sections = {"replay": {"demonstrations": (str(episodes),)}, "run": {"frames": None, "updates": updates}}
    return tiny(folder, **{**sections, "collection": {"enabled": False}, **changes})


def test_run_keeps_the_episodes_that_are_in_its_replay(kept):
    run, episodes = kept
    save = list_saves(run)[-1]
    rows = torch.load(save / "rows.pt", weights_only=True)
    frames = np.fromfile(next((run / "resume" / "logs").iterdir()), np.uint8).reshape(-1, 64, 64, 3)
    recordings = open_recordings([str(episodes)])
    assert len(recordings) == 4  # 90 decisions in episodes of 20
    start = 0
    for recording in recordings:
        read = FittedRecording(recording, target()).read(0)
        end = start + len(read.frames)
        assert np.array_equal(read.frames, frames[start:end])
        assert np.allclose(read.actions, rows["actions"][start:end].clamp(-1, 1), atol=1e-6)
        assert np.array_equal(read.rewards, rows["rewards"][start:end])
        start = end


def test_run_that_keeps_episodes_equals_one_that_does_not(kept, finished):
    assert fingerprint(kept[0]) == fingerprint(finished.run_dir)


def test_resumed_run_keeps_the_same_episodes(kept, tiny, dot, tmp_path, interrupting):
    config = tiny(tmp_path / "run", collection={"keep_episodes": str(tmp_path / "episodes")})
    make_env = interrupting(dot, at_step=105).make
    make_env.__name__ = "Dot"  # a file names its environment
    assert train(config, make_env).exit_code == 130  # within an episode
    assert resume(tmp_path / "run", make_env=dot).exit_code == 0
    own, others = (
        {path.name: path.read_bytes() for path in sorted(folder.iterdir())}
        for folder in (tmp_path / "episodes", kept[1])
    )
    assert own == others


def test_new_run_refuses_a_folder_with_episodes(kept, tiny, dot, tmp_path):
    with pytest.raises(UserError, match="already holds recorded episodes"):
        train(tiny(tmp_path / "run", collection={"keep_episodes": str(kept[1])}), dot)


def test_resumed_run_refuses_a_folder_with_episodes_of_others(kept, tiny, dot, tmp_path):
    before = {path.name: path.read_bytes() for path in kept[1].iterdir()}
    run, own = tmp_path / "run", tmp_path / "episodes"
    train(tiny(run, run={"seed": 7}, collection={"keep_episodes": str(own)}), dot)
    text = (run / "config.yaml").read_text()
    (run / "config.yaml").write_text(text.replace(str(own), str(kept[1])))
    with (
        pytest.warns(RuntimeWarning, match="was edited"),
        pytest.raises(UserError, match=f"{kept[1]} already holds recorded episodes"),
    ):
        resume(run, frames=120, make_env=dot)
    assert {path.name: path.read_bytes() for path in kept[1].iterdir()} == before
    copy = list_saves(run)[-1] / "config.yaml"
    check_kept(read_config(copy), copy, has_other_ranks=False)
    with pytest.raises(UserError, match=f"{own} already holds recorded episodes"):
        check_kept(read_config(copy), copy, has_other_ranks=True)


def begin_in(folder, monkeypatch):
    """Makes a folder the present one, in which a new run keeps its episodes as `episodes`."""
    folder.mkdir()
    monkeypatch.chdir(folder)
    return {"keep_episodes": "episodes"}


def test_run_that_resumes_elsewhere_keeps_its_episodes_where_it_began(tiny, dot, tmp_path, monkeypatch):
    train(tiny(tmp_path / "run", collection=begin_in(tmp_path / "here", monkeypatch)), dot)
    begin_in(tmp_path / "there", monkeypatch)
    (tmp_path / "there" / "episodes").mkdir()
    other = tmp_path / "there" / "episodes" / "episode-000-000005.hdf5"
    other.write_text("precious")
    resume(tmp_path / "run", frames=120, make_env=dot)
    assert len(list((tmp_path / "here" / "episodes").iterdir())) == 6 and other.read_text() == "precious"


def test_run_whose_episodes_cannot_be_written_is_saved(tiny, dot, tmp_path, monkeypatch):
    config = tiny(tmp_path / "run", collection={"keep_episodes": str(tmp_path / "episodes"), "overlap": False})
    write, written = keeping.write_episode, []

    def write_two(path, *arguments):
        if len(written) == 2:
            raise UserError(f"the episode {path} cannot be written: No space left on device")
        written.append(path)
        write(path, *arguments)

    with monkeypatch.context() as patched:
        patched.setattr(keeping, "write_episode", write_two)
        with pytest.raises(UserError, match=r"No space left on device; the run is saved in .*run"):
            train(config, dot)
    assert read_state(tmp_path / "run")["run"]["env_frames"] > 0
    assert resume(tmp_path / "run", make_env=dot).exit_code == 0
    assert len(list((tmp_path / "episodes").iterdir())) == 4


def test_offline_run_learns_evaluates_and_counts_no_frames(kept, tiny, dot, tmp_path):
    run = train(offline(tiny, tmp_path / "run", kept[1], updates=40), dot)
    assert run.exit_code == 0 and set(run.summary) == {"planner", "actor"}
    state = read_state(run.run_dir)
    assert (state["run"]["env_frames"], state["run"]["decisions"], state["learner"]["updates"]) == (0, 0, 40)
    assert [int(row["updates"]) for row in read_epochs(run.run_dir)] == [6, 12, 18, 24, 30, 36, 40]
    # An evaluation every 40 frames, which stand for 16 updates, when an epoch of 6 begins; and the final one.
    assert [entry.updates for entry in read_evaluations(run.run_dir)] == [0, 18, 36, 40]
    assert float(read_epochs(run.run_dir)[-1]["reconstruction"]) < float(read_epochs(run.run_dir)[0]["reconstruction"])


def test_resumed_offline_run_equals_an_uninterrupted_one_without_its_recordings(
    kept, tiny, dot, tmp_path, interrupting
):
    episodes = shutil.copytree(kept[1], tmp_path / "episodes")
    settings = {"evaluation": {"every_frames": 40, "episodes": 1, "final_episodes": 2}}
    config = offline(tiny, tmp_path / "run", episodes, **settings)
    whole = train(config, dot)
    stopped = train(
        replace(config, run=replace(config.run, run_dir=str(tmp_path / "part"))), interrupting(dot, at_step=42).make
    )  # in the first evaluation, or after it
    assert stopped.exit_code == 130
    shutil.rmtree(episodes)
    assert resume(tmp_path / "part", make_env=dot).exit_code == 0
    assert fingerprint(tmp_path / "part") == fingerprint(whole.run_dir)


def test_run_with_recordings_that_crashed_equals_an_uninterrupted_one(kept, tiny, dot, tmp_path, monkeypatch):
    monkeypatch.setattr(saving, "SAVE_MINUTES", 0.0)
    replay = {"demonstrations": (str(kept[1]),)}
    whole = train(tiny(tmp_path / "whole", replay=replay), dot)
    steps = iter(range(100))

    class Crash(BaseException):
        pass

    def step(self, action):
        if next(steps) == 99:
            raise Crash
        return dot.step(self, action)

    with pytest.raises((Crash, StopIteration)):
        train(tiny(tmp_path / "part", replay=replay), type("Crashing", (dot,), {"step": step}))
    assert resume(tmp_path / "part", make_env=dot).exit_code == 0
    assert fingerprint(tmp_path / "part") == fingerprint(whole.run_dir)
    assert read_state(tmp_path / "part")["run"]["env_frames"] == 90


def test_recorded_rows_are_saved_beside_the_collected_ones(kept, tiny, dot, tmp_path):
    run = train(tiny(tmp_path / "run", replay={"demonstrations": (str(kept[1]),), "capacity": 30}), dot)
    assert count_saved(saving_of(run.run_dir)) == (1, 30, 4 * 21)


def saving_of(folder):
    from latentplan.config.run_folder import run_saves

    return run_saves(folder).newest()[0]


def test_terminal_states_of_recordings_are_weighed_by_plans(tiny, dot, tmp_path):
    write_minari(tmp_path / "minari", terminated=True)
    run = train(offline(tiny, tmp_path / "run", tmp_path / "minari"), dot)
    from latentplan import load_agent

    assert load_agent(run.run_dir, "planner").config.planner.use_continues is True


def test_offline_run_goes_on_with_collection_of_its_own(kept, tiny, dot, tmp_path):
    run = train(offline(tiny, tmp_path / "run", kept[1], updates=36), dot)
    config = read_config(run.run_dir / "config.yaml")
    collecting = replace(config, collection=replace(config.collection, enabled=True))
    dump_config(collecting, run.run_dir / "config.yaml")
    with pytest.warns(RuntimeWarning, match="collection.enabled from False to True"):
        resume(run.run_dir, frames=105, make_env=dot)
    assert read_state(run.run_dir)["run"]["env_frames"] == 105
    frames = [int(row["env_frames"]) for row in read_rows(run.run_dir) if row["planner_return"]]
    assert max(frames) == 90  # evaluations by frames begin with the frames


def test_changed_recordings_of_a_run_are_refused(kept, tiny, dot, tmp_path):
    run = train(offline(tiny, tmp_path / "run", kept[1]), dot)
    config = read_config(run.run_dir / "config.yaml")
    dump_config(replace(config, replay=ReplayConfig(demonstrations=("other",))), run.run_dir / "config.yaml")
    with pytest.raises(UserError, match="replay.demonstrations in .* cannot change in a run that resumes"):
        resume(run.run_dir, make_env=dot)


def test_collection_cannot_end_in_a_run_that_resumes(kept, tiny, dot, tmp_path):
    run = train(tiny(tmp_path / "run", replay={"demonstrations": (str(kept[1]),)}, run={"frames": 60}), dot)
    config = read_config(run.run_dir / "config.yaml")
    settings = {"collection": replace(config.collection, enabled=False), "run": replace(config.run, frames=None)}
    dump_config(replace(config, **settings), run.run_dir / "config.yaml")
    with pytest.raises(UserError, match="collection.enabled in .* cannot become false"):
        resume(run.run_dir, updates=50, make_env=dot)


def test_recording_that_does_not_fit_is_refused_before_a_worker_starts(tiny, dot, tmp_path, monkeypatch):
    monkeypatch.setattr("latentplan.training.run.make_worker", lambda *_: pytest.fail("a worker was started"))
    write_minari(tmp_path / "minari", decisions=3)
    with pytest.raises(UserError, match="no recorded episode has learning.sequence_length"):
        train(offline(tiny, tmp_path / "run", tmp_path / "minari"), dot)
    with pytest.raises(UserError, match="there is no "):
        train(offline(tiny, tmp_path / "other", tmp_path / "missing"), dot)


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--minutes", "1"], "collection.enabled false needs something else to learn from"),
        (["--frames", "100", "--replay.demonstrations", "x"], "give --updates or --minutes"),
        (["--updates", "9", "--replay.demonstrations", "x", "--collection.keep_episodes", "y"], "has no effect where"),
        (["--updates", "9", "--replay.demonstrations", "missing", "other"], "there is no missing"),
    ],
)
def test_settings_that_contradict_each_other_end_with_one_line(flags, message, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    code = main(["train", "--domain", "cartpole", "--device", "cpu", "--collection.enabled", "false", *flags])
    lines = capsys.readouterr().err.strip().splitlines()
    assert code == 2 and len(lines) == 1 and message in lines[0]


def test_online_run_ends_after_its_updates(tiny, dot, tmp_path):
    run = train(tiny(tmp_path / "run", run={"frames": None, "updates": 8}, replay={"capacity": 90}), dot)
    state = read_state(run.run_dir)
    assert state["learner"]["updates"] == 8 and state["run"]["env_frames"] > 45


def test_epoch_that_a_budget_cuts_closes_when_a_signal_arrives_in_it(tiny, dot, tmp_path, monkeypatch):
    count = Collect.on_train_batch_end

    def interrupt(self, trainer, learner, *rest):
        count(self, trainer, learner, *rest)
        if learner.updates == 8:
            self.state.interrupted = 2

    monkeypatch.setattr(Collect, "on_train_batch_end", interrupt)
    run = train(tiny(tmp_path / "run", run={"frames": None, "updates": 8}, replay={"capacity": 90}), dot)
    assert run.exit_code == 130
    state = read_state(run.run_dir)
    assert state["learner"]["updates"] == 8 and not state["run"]["in_epoch"]
