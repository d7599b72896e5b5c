"""Recordings for tests, of a dot in a picture: an episode of each format with the same contents."""

import io
import json

import av
import cv2
import numpy as np
import pyarrow
import pyarrow.parquet
from gymnasium import spaces
from minari.data_collector import EpisodeBuffer
from minari.dataset.minari_storage import MinariStorage

from latentplan.config import EnvConfig
from latentplan.envs.process import read_facts
from latentplan.envs.user import PixelEnv
from latentplan.training.demonstrations.fitting import make_target
from tests.training.dot import Dot

PICTURE = Dot.observation_space
CONFIG = EnvConfig(action_repeat=1, domain="user", task="Dot")


class TwoParts(Dot):
    """A dot whose place is a vector beside the picture; actions are pushes from -2 to 2."""

    observation_space = spaces.Dict({"camera": PICTURE, "place": spaces.Box(-1.0, 1.0, (1,))})
    action_space = spaces.Box(-2.0, 2.0, (1,), np.float32)

    def step(self, action):
        return super().step(action / 2.0)

    def picture(self):
        return {"camera": super().picture(), "place": np.array([self.place], np.float32)}


def target(kind=Dot, **settings):
    """What recordings have to fit in an environment of a class."""
    config = EnvConfig(**{"action_repeat": 1, "domain": "user", "task": "Dot", **settings})
    env = PixelEnv(kind(), config.action_repeat, 0, config)
    return make_target(config, read_facts(env), deter_dim=4)


def play(kind, decisions=20, seed=0):
    """Observations, actions (as the environment takes them), and rewards of an episode of random actions."""
    env, rng = kind(), np.random.default_rng(seed)
    observations, actions, rewards = [env.reset(seed=seed)[0]], [], []
    for _ in range(decisions):
        actions.append(rng.uniform(env.action_space.low, env.action_space.high).astype(np.float32))
        observation, reward, *_ = env.step(actions[-1])
        observations.append(observation)
        rewards.append(reward)
    return observations, np.stack(actions), np.array(rewards)


def stacked(observations):
    if isinstance(observations[0], dict):
        return {name: np.stack([each[name] for each in observations]) for name in observations[0]}
    return np.stack(observations)


def write_minari(folder, kind=Dot, episodes=2, decisions=20, terminated=False, changes=None, **spaces_given):
    """A Minari dataset of random episodes, as Minari writes it; pictures lie in it without loss."""
    (data := folder / "data").mkdir(parents=True)
    given = {"observation_space": kind.observation_space, "action_space": kind.action_space, **spaces_given}
    storage = MinariStorage.new(data, data_format="hdf5", **{"jpeg_encoding": False, **given})
    storage.update_metadata({"dataset_id": "dot/random-v0", "minari_version": "0.5.3"})
    for seed in range(episodes):
        observations, actions, rewards = play(kind, decisions, seed)
        last = np.arange(decisions) == decisions - 1
        buffer = {"observations": stacked(observations), "actions": actions, "rewards": rewards}
        buffer |= {"terminations": last & terminated, "truncations": last & (not terminated), "infos": {}}
        storage.update_episodes([EpisodeBuffer(**buffer | (changes or {}))])
    return folder


def write_lerobot(folder, kind=TwoParts, episodes=2, decisions=20, video=True, changes=None):
    """A LeRobot dataset by the layout of its format v3: one data file, and one video file or pictures in the table."""
    for name in ("meta/episodes/chunk-000", "data/chunk-000"):
        (folder / name).mkdir(parents=True)
    rows, entries, pictures, key = [], [], [], "observation.images.camera"
    for episode in range(episodes):
        observations, actions, rewards = play(kind, decisions, seed=episode)
        entry = {"episode_index": episode, "length": decisions, "data/chunk_index": 0, "data/file_index": 0}
        entry |= {f"videos/{key}/{name}_index": 0 for name in ("chunk", "file")}
        entries.append(entry | {f"videos/{key}/from_timestamp": len(pictures) / 10.0, "stats/reward": [0.0]})
        for time in range(decisions):
            pictures.append(cv2.resize(observations[time]["camera"], (64, 64)))
            row = {"episode_index": episode, "frame_index": time, "timestamp": time / 10.0}
            row |= {"observation.place": observations[time]["place"].tolist(), "action": actions[time].tolist()}
            row |= {"next.reward": [float(rewards[time])], "next.done": time == decisions - 1}
            if not video:
                content = cv2.imencode(".png", np.ascontiguousarray(pictures[-1][..., ::-1]))[1].tobytes()
                row[key] = {"bytes": content, "path": None}
            rows.append(row)
    features = {
        key: {"dtype": "video" if video else "image", "shape": [3, 64, 64], "names": ["channels", "height", "width"]},
        "observation.place": {"dtype": "float32", "shape": [1], "names": None},
        "action": {"dtype": "float32", "shape": [1], "names": ["push"]},
        "next.reward": {"dtype": "float32", "shape": [1], "names": None},
        "next.done": {"dtype": "bool", "shape": [1], "names": None},
        "timestamp": {"dtype": "float32", "shape": [1], "names": None},
        "frame_index": {"dtype": "int64", "shape": [1], "names": None},
    }
    info = {"codebase_version": "v3.0", "fps": 10, "features": features}
    info["data_path"] = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
    info["video_path"] = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
    (folder / "meta" / "info.json").write_text(json.dumps(info | (changes or {})))
    for path, table in {"meta/episodes/chunk-000": entries[::-1], "data/chunk-000": rows[::-1]}.items():
        pyarrow.parquet.write_table(pyarrow.Table.from_pylist(table), folder / path / "file-000.parquet")
    if video:
        (path := folder / "videos" / key / "chunk-000").mkdir(parents=True)
        (path / "file-000.mp4").write_bytes(encode_video(pictures))
    return folder


def encode_video(pictures, fps=10):
    target = io.BytesIO()
    with av.open(target, "w", format="mp4") as container:
        stream = container.add_stream("libx264", rate=fps, options={"crf": "1", "g": "8"})
        stream.width, stream.height, stream.pix_fmt = pictures[0].shape[1], pictures[0].shape[0], "yuv444p"
        for picture in pictures:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
        container.mux(stream.encode())
    return target.getvalue()
