"""Recordings of LeRobot, format v3: tables in Parquet, pictures in MP4 files or in the tables; only read.

The layout is that of the package `lerobot`, which is not used itself: its versions pin other versions of gymnasium and
einops. `meta/info.json` lists the features and how paths are made; `meta/episodes/` has one row for each episode, which
says where its rows and its pictures lie; a data file and a video file hold several episodes.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import gymnasium
import numpy as np

from latentplan.config import UserError
from latentplan.config.extras import import_extra, require_extra
from latentplan.training.demonstrations.kinds import INFO
from latentplan.training.demonstrations.recording import RecordedEpisode, describe_damage, name_space

REWARD, ACTION = "next.reward", "action"
USER = "a LeRobot dataset"


class LeRobotDataset:
    """The episodes of a LeRobot dataset; see `Recording`.

    A dataset has as many pictures as actions, so that the picture after the last action is missing: the last action of
    an episode and its reward are left out, and every episode counts as cut. An action is held for one step of the
    environment. Names lose their beginning `observation.` or `observation.images.`.

    Args:
        path: Folder of the dataset.

    Raises:
        UserError: The dataset has another format, no pictures, no actions or no rewards, or is damaged.
    """

    bounds: np.ndarray | None = None
    quantities: tuple[str, ...] = ()
    action_repeat, is_own, origin = 1, False, ""

    def __init__(self, path: Path) -> None:
        self.path = path
        require_extra(USER, "pyarrow", "av")
        try:
            self._info = json.loads((path / INFO).read_text())
            version, features = str(self._info["codebase_version"]), self._info["features"]
            self._fps = float(self._info["fps"])
            if not version.startswith("v3."):
                raise UserError(f"{path} has format {version} of LeRobot, and v3 is read: convert it with lerobot")
            self._pictures = {_short(key): key for key, feature in features.items() if _is_shown(feature)}
            self._vectors = {_short(key): key for key, feature in features.items() if _is_vector(key, feature)}
            for key, what in {ACTION: "actions", REWARD: "rewards"}.items():
                if key not in features:
                    raise UserError(f"{path} has no {what}: a run learns from datasets with a feature {key!r}")
            shapes = {name: _picture_shape(features[key]["shape"]) for name, key in self._pictures.items()}
            spaces: dict[str, gymnasium.Space[Any]] = {
                name: gymnasium.spaces.Box(0, 255, shape, np.uint8) for name, shape in shapes.items()
            }
            sizes = {name: tuple(features[key]["shape"]) for name, key in self._vectors.items()}
            spaces |= {name: gymnasium.spaces.Box(-np.inf, np.inf, size) for name, size in sizes.items()}
            self.space = name_space(path, gymnasium.spaces.Dict(spaces))
            self.num_numbers = int(np.prod(features[ACTION]["shape"]))
            self._episodes = self._read_episodes()
            self.lengths = [max(0, int(row["length"]) - 1) for row in self._episodes]
        except UserError:
            raise
        except Exception as error:  # the readers of tables and films raise many kinds for damaged files
            raise describe_damage(path, USER, error) from None

    def read(self, index: int) -> RecordedEpisode:
        """An episode, without its last action."""
        episode = self._episodes[index]
        try:
            rows = self._read_rows(episode)
            frames = {name: self._read_pictures(key, episode, rows) for name, key in self._pictures.items()}
            vectors = {
                name: np.array(rows[key], np.float32).reshape(len(rows[key]), -1) for name, key in self._vectors.items()
            }
            actions = np.array(rows[ACTION], np.float64).reshape(len(rows[ACTION]), -1)[:-1]
            rewards = np.array(rows[REWARD], np.float64).reshape(-1)[:-1]
        except UserError:
            raise
        except Exception as error:
            raise describe_damage(self.path, USER, error) from None
        counts = {len(values) for values in (frames | vectors).values()} | {len(rows[ACTION]), len(rows[REWARD])}
        if counts != {int(episode["length"])}:
            raise UserError(f"{self.path} is damaged: episode {index} must have {episode['length']} rows and pictures")
        return RecordedEpisode(frames | vectors, actions, rewards, is_terminal=False)

    def _read_episodes(self) -> list[dict[str, Any]]:
        """One row for each episode, without its statistics, in order."""
        parquet: Any = import_extra("pyarrow.parquet", USER)
        found: list[dict[str, Any]] = []
        for path in sorted((self.path / "meta" / "episodes").glob("*/*.parquet")):
            names = [name for name in parquet.read_schema(path).names if not name.startswith("stats/")]
            found += parquet.read_table(path, columns=names).to_pylist()
        if not found:
            raise ValueError("meta/episodes holds no episode")
        return sorted(found, key=lambda row: int(row["episode_index"]))

    def _read_rows(self, episode: dict[str, Any]) -> dict[str, list[Any]]:
        """The columns of an episode's rows, in the order of time."""
        parquet: Any = import_extra("pyarrow.parquet", USER)
        place = {"chunk_index": int(episode["data/chunk_index"]), "file_index": int(episode["data/file_index"])}
        path = self._find(str(self._info["data_path"]).format(**place))
        images = [key for key in self._pictures.values() if self._info["features"][key]["dtype"] == "image"]
        columns = ["frame_index", ACTION, REWARD, *self._vectors.values(), *images]
        number = int(episode["episode_index"])
        table = parquet.read_table(path, columns=columns, filters=[("episode_index", "=", number)])
        return table.sort_by("frame_index").to_pydict()  # type: ignore[no-any-return]

    def _read_pictures(self, key: str, episode: dict[str, Any], rows: dict[str, list[Any]]) -> np.ndarray:
        """The pictures of an episode, uint8 (time, height, width, 3)."""
        if key in rows:
            return np.stack([self._decode_image(image) for image in rows[key]])
        place = {name: int(episode[f"videos/{key}/{name}"]) for name in ("chunk_index", "file_index")}
        path = self._find(str(self._info["video_path"]).format(video_key=key, **place))
        start = float(episode[f"videos/{key}/from_timestamp"])
        return np.stack(list(_decode_video(path, start, int(episode["length"]), self._fps)))

    def _find(self, name: str) -> Path:
        """A file that the dataset names, which lies in its folder.

        Raises:
            ValueError: The dataset names something else, such as a file of the user.
        """
        if os.path.isabs(name) or os.path.normpath(name).split(os.sep)[0] == "..":
            raise ValueError(f"it names {name}, which is outside of its folder")
        if not (path := self.path / name).is_file():
            raise ValueError(f"it names {name}, which is no file")
        return path

    def _decode_image(self, image: dict[str, Any]) -> np.ndarray:
        content = image["bytes"] if image["bytes"] is not None else self._find(image["path"]).read_bytes()
        picture = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_COLOR)
        if picture is None:
            raise ValueError("a picture cannot be decoded")
        return np.ascontiguousarray(picture[..., ::-1])


def _short(key: str) -> str:
    return key.removeprefix("observation.").removeprefix("images.")


def _is_shown(feature: dict[str, Any]) -> bool:
    """Whether a feature holds pictures of colours."""
    is_depth = (feature.get("info") or {}).get("video.is_depth_map", False)
    return feature["dtype"] in ("image", "video") and not is_depth


def _is_vector(key: str, feature: dict[str, Any]) -> bool:
    is_other = key in (ACTION, "timestamp") or key.startswith("next.")
    return str(feature["dtype"]).startswith("float") and len(feature["shape"]) == 1 and not is_other


def _picture_shape(shape: list[int]) -> tuple[int, int, int]:
    """The shape of a decoded picture; a feature may name the channels first."""
    first, second, third = shape
    return (second, third, 3) if first == 3 and third != 3 else (first, second, 3)


def _decode_video(path: Path, start: float, count: int, fps: float) -> Iterator[np.ndarray]:
    """The `count` pictures of a video from a time in seconds on, uint8 (height, width, 3) each."""
    av: Any = import_extra("av", USER)
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        container.seek(max(0, int((start - 1.0 / fps) / stream.time_base)), stream=stream)
        for frame in container.decode(stream):
            if count == 0:
                return
            if frame.time is not None and frame.time >= start - 0.5 / fps:
                yield frame.to_ndarray(format="rgb24")
                count -= 1
