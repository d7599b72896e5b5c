"""Kept episodes: the file of an episode holds what the run collected, whole or not at all."""

import json
import os
from dataclasses import replace

import h5py
import numpy as np
import pytest

from latentplan.config import EnvConfig, UserError
from latentplan.envs import wrap_user_env
from latentplan.training.collection.keeping import EpisodeKeeper, KeepingEnv
from latentplan.training.demonstrations.episode_file import EpisodeFile, write_episode
from latentplan.training.demonstrations.fitting import FittedRecording, fit_all
from latentplan.training.demonstrations.opening import open_recordings
from tests.training.demonstrations.recorded import CONFIG, TwoParts, target
from tests.training.dot import Dot


def keep(folder, kind=TwoParts, episodes=2, **settings):
    """Plays random episodes in an environment that keeps them; returns frames, actions and rewards of the last one."""
    config = EnvConfig(**{"action_repeat": 1, "domain": "user", "task": "Dot", "vectors": ("place",), **settings})
    env, rng = KeepingEnv(wrap_user_env(kind(), config.action_repeat, config=config), folder, config), None
    rng = np.random.default_rng(0)
    for seed in range(episodes):
        frames, actions, rewards, is_over = [env.reset(seed=seed)[0]], [], [], False
        while not is_over:
            actions.append(rng.uniform(-1, 1, 1).astype(np.float32))
            frame, reward, terminated, truncated, _ = env.step(actions[-1])
            frames.append(frame), rewards.append(reward)
            is_over = terminated or truncated
    env.reset(seed=9)  # an episode that does not end
    env.step(actions[-1])
    return np.stack(frames), np.stack(actions), np.array(rewards)


@pytest.fixture
def folder(tmp_path):
    keep(tmp_path / "kept")
    return tmp_path / "kept"


def test_kept_episode_returns_as_rows(tmp_path):
    frames, actions, rewards = keep(tmp_path / "kept")
    first, second = open_recordings([str(tmp_path / "kept")])
    assert [path.name for path in (first.path, second.path)] == [f"episode-000-{n:06d}.hdf5" for n in (1, 2)]
    rows = FittedRecording(second, target(TwoParts, vectors=("place",))).read(0)
    assert np.array_equal(rows.frames, frames)
    assert np.allclose(rows.actions[:-1], actions, atol=1e-6)
    assert np.array_equal(rows.rewards[:-1], rewards.astype(np.float32))
    assert rows.labels.shape == (21, 1) and rows.continues.all()


def test_file_holds_the_units_of_the_environment(folder):
    with h5py.File(folder / "episode-000-000001.hdf5") as file:
        assert json.loads(file.attrs["environment"])["task"] == "Dot"
        assert (file["actions"].attrs["low"], file["actions"].attrs["high"]) == (-2.0, 2.0)
        assert 1.0 < np.abs(file["actions"][()]).max() <= 2.0
        assert file["observations/camera"].shape == (21, 64, 64, 3)
        assert file["truncations"][()].tolist() == [False] * 19 + [True] and not file["terminations"][()].any()


def test_same_episode_gives_the_same_file(folder, tmp_path):
    keep(tmp_path / "again")
    for name in os.listdir(folder):
        assert (folder / name).read_bytes() == (tmp_path / "again" / name).read_bytes()


def test_environment_of_the_suite_keeps_cameras_quantities_and_the_range_of_its_actuators(tmp_path):
    from latentplan.envs import make_env

    config = EnvConfig(domain="cartpole", task="balance", action_repeat=100, cameras=("1", "0"), vectors=("velocity",))
    env = KeepingEnv(make_env(config), tmp_path, config)
    env.reset(seed=0)
    for _ in range(10):
        frame, _, _, _, info = env.step(np.array([0.5], np.float32))
    env.close()
    (recording,) = open_recordings([str(tmp_path)])
    episode = recording.read(0)
    assert np.array_equal(np.concatenate([episode.observations[name][-1] for name in "10"], axis=2), frame)
    assert recording.quantities == tuple(env.unwrapped.labels) and np.array_equal(
        episode.quantities[-1], info["labels"]
    )
    assert np.array_equal(episode.observations["velocity"][-1], info["vectors"])
    assert recording.origin == "dm_control-cartpole-balance" and recording.lengths == [10]


def test_episodes_of_all_workers_and_processes_of_a_run_are_read(folder):
    """Worker k > 0 and process r > 0 keep theirs in folders below; the order does not depend on the disk."""
    below = ("worker-1", "worker-2", "rank-1", "rank-1/worker-1")
    for name in below[::-1]:
        (folder / name).mkdir(parents=True, exist_ok=True)
        for file in folder.glob("*.hdf5"):
            (folder / name / file.name).write_bytes(file.read_bytes())
    (folder / "other").mkdir()
    (folder / "episode-000-000001.hdf5").rename(folder / "other" / "episode-000-000001.hdf5")
    first, second = (f"episode-000-{number:06d}.hdf5" for number in (1, 2))
    expected = [second, *(f"{name}/{file}" for name in below for file in (first, second))]
    found = open_recordings([str(folder)])
    assert [str(recording.path.relative_to(folder)) for recording in found] == expected
    (folder / second).unlink()
    assert [str(recording.path.relative_to(folder)) for recording in open_recordings([str(folder)])] == expected[1:]
    with pytest.raises(UserError, match="already holds recorded episodes"):
        KeepingEnv(wrap_user_env(Dot()), folder, CONFIG)


def test_two_environments_may_not_keep_their_episodes_in_one_folder(tmp_path):
    first = KeepingEnv(wrap_user_env(Dot()), tmp_path / "kept", CONFIG)
    with pytest.raises(UserError, match="something else keeps its episodes in .*kept"):
        KeepingEnv(wrap_user_env(Dot()), tmp_path / "kept", CONFIG)
    first.close()
    KeepingEnv(wrap_user_env(Dot()), tmp_path / "kept", CONFIG).close()


def test_write_that_fails_leaves_the_file_before(folder, monkeypatch):
    path = folder / "episode-000-000001.hdf5"
    before, episode = path.read_bytes(), EpisodeFile(path).read(0)

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(UserError, match="cannot be written: No space left on device"):
        write_episode(path, episode, target(TwoParts, vectors=("place",)).interface, (), CONFIG)
    assert path.read_bytes() == before
    assert len(open_recordings([str(folder)])) == len(list(folder.iterdir())) == 2  # no part is left on the full disk


@pytest.mark.parametrize("damage", ["cut", "byte", "entry", "length", "version", "format", "flat", "empty", "group"])
def test_damaged_file_is_refused_in_one_line(damage, folder):
    path = folder / "episode-000-000001.hdf5"
    content = bytearray(path.read_bytes())
    with h5py.File(path, "a") as file:
        place = file["observations/camera"].id.get_chunk_info(0).byte_offset
        if damage == "entry":
            del file["rewards"]
        elif damage == "length":
            rewards = file["rewards"][:-1]
            del file["rewards"]
            file["rewards"] = rewards
        elif damage in ("flat", "empty", "group"):
            name = {"flat": "actions", "empty": "terminations", "group": "observations/camera"}[damage]
            attributes = dict(file[name].attrs)
            del file[name]
            if damage == "group":
                file.create_group(name)
            else:
                file[name] = np.zeros(0 if damage == "empty" else 20)
                file[name].attrs.update(attributes)
        elif damage in ("version", "format"):
            file.attrs[damage] = 99
    if damage in ("cut", "byte"):
        content[place + 20] ^= 1
        path.write_bytes(content if damage == "byte" else content[:place])
    with pytest.raises(UserError, match="damaged|update it|no episode file") as error:
        EpisodeFile(path).read(0)
    assert "\n" not in str(error.value)


def test_other_steps_cameras_and_tasks_are_noticed(folder):
    recordings = open_recordings([str(folder)])
    aim = target(TwoParts, vectors=("place",))
    with pytest.raises(UserError, match="give --env.action_repeat 1"):
        fit_all(recordings, replace(aim, env=replace(aim.env, action_repeat=3)), 5)
    with pytest.raises(UserError, match="shows camera, and the environment other"):
        fit_all(recordings, replace(aim, interface=replace(aim.interface, pictures=("other",))), 5)
    with pytest.raises(UserError, match=r"lacks the quantities that user reports .*\(speed, ...\)"):
        fit_all(recordings, replace(aim, labels=("speed",)), 5)
    with pytest.raises(UserError, match=r"no recorded episode has learning.sequence_length \(21\) decisions"):
        fit_all(recordings, aim, 21)
    with pytest.warns(RuntimeWarning, match=r"user-Dot, and this run learns dm_control-user-Other: .*\(2 of 2"):
        fit_all(recordings, replace(aim, env=replace(aim.env, task="Other")), 5)


@pytest.mark.parametrize("values", [np.full((21, 1), np.nan), np.zeros((20, 1)), np.zeros((21, 2))])
def test_quantities_that_do_not_fit_are_refused_in_one_line(values, folder, tmp_path):
    aim = target(TwoParts, vectors=("place",))
    episode = replace(open_recordings([str(folder)])[0].read(0), quantities=values)
    write_episode(tmp_path / "one.hdf5", episode, aim.interface, ("speed",), CONFIG)
    fitted = FittedRecording(EpisodeFile(tmp_path / "one.hdf5"), replace(aim, labels=("speed",)))
    with pytest.raises(UserError, match="quantities of episode 0 must be finite, 1 numbers for each of 21 frames"):
        fitted.read(0)


@pytest.mark.parametrize("names", [("cam", "cam/wrist"), (".",), ("/",), ("a//b",), (0, 1)])
def test_names_that_a_file_cannot_hold_are_refused_before_an_episode(names, tmp_path):
    interface = replace(target().interface, pictures=names)
    with pytest.raises(UserError, match="episodes cannot be kept: .*observation"):
        EpisodeKeeper(tmp_path / "kept", CONFIG, interface, (), 1)
    assert not (tmp_path / "kept").exists()


def test_used_folder_is_refused(folder):
    with pytest.raises(UserError, match="already holds recorded episodes"):
        KeepingEnv(wrap_user_env(Dot()), folder, CONFIG)


@pytest.mark.parametrize("kind", ["storage", "link", "virtual"])
def test_episode_file_that_takes_its_data_from_another_file_is_refused(folder, tmp_path, kind):
    """A stranger's file could otherwise put any file of the user into replay, which run folders hold."""
    secret, path = tmp_path / "secret", folder / "episode-000-000001.hdf5"
    with h5py.File(secret, "w") as file:
        file["rewards"] = np.ones(20)
    with h5py.File(path, "r+") as file:
        del file["rewards"]
        if kind == "storage":
            file.create_dataset("rewards", (20,), np.uint8, external=[(str(secret), 0, 20)])
        elif kind == "link":
            file["rewards"] = h5py.ExternalLink(str(secret), "rewards")
        else:
            layout = h5py.VirtualLayout((20,), np.float64)
            layout[:] = h5py.VirtualSource(str(secret), "rewards", (20,))
            file.create_virtual_dataset("rewards", layout)
    with pytest.raises(UserError, match="takes 'rewards' from elsewhere"):
        open_recordings([str(path)])


def test_folder_that_holds_a_pipe_among_its_episodes_is_read(folder):
    os.mkfifo(folder / "episode-000-000000.hdf5")
    assert len(open_recordings([str(folder)])) == 2


@pytest.mark.parametrize("kind", ["suite", "own"])
def test_episode_that_was_kept_without_the_name_of_a_task_is_of_the_task_that_was_played(tmp_path, kind, recwarn):
    if kind == "suite":
        from latentplan.envs import make_env

        config = EnvConfig(domain="cartpole", action_repeat=500)
        env, fits = make_env(config), None
    else:
        config = EnvConfig(action_repeat=1)
        env, fits = wrap_user_env(Dot()), target()
    env = KeepingEnv(env, tmp_path, config)
    env.reset(seed=0)
    while not any(env.step(np.array([0.5], np.float32))[2:4]):
        pass
    env.close()
    (recording,) = open_recordings([str(tmp_path)])
    if fits is None:
        assert recording.origin == "dm_control-cartpole-swingup"
    else:
        fit_all([recording], fits, 1)
        assert not [each for each in recwarn if "was recorded in" in str(each.message)]
