"""Recordings of each format become rows with the contents of the episodes."""

import json

import cv2
import numpy as np
import pyarrow
import pyarrow.parquet
import pytest
from gymnasium import spaces

from latentplan.config import UserError
from latentplan.envs.spaces import resize
from latentplan.training.demonstrations.fitting import FittedRecording
from latentplan.training.demonstrations.opening import open_recordings
from tests.training.demonstrations.recorded import PICTURE, TwoParts, play, target, write_lerobot, write_minari
from tests.training.dot import Dot


def read(path, kind=Dot, index=0, **settings):
    (recording,) = open_recordings([str(path)])
    return FittedRecording(recording, target(kind, **settings)).read(index)


@pytest.mark.parametrize("place", [".", "data", "data/main_data.hdf5"])
def test_minari_dataset_becomes_rows(place, tmp_path):
    rows = read(write_minari(tmp_path / "minari") / place, index=1)
    observations, actions, rewards = play(Dot, seed=1)
    assert np.array_equal(rows.frames, [resize(picture, 64) for picture in observations])
    assert np.allclose(rows.actions[:-1], actions) and rows.actions[-1] == 0.0
    assert np.allclose(rows.rewards[:-1], rewards) and rows.rewards[-1] == 0.0
    assert rows.continues.all() and np.flatnonzero(rows.is_first).tolist() == [0]
    assert rows.labels.shape == (21, 0) and not rows.deter.any()


def test_minari_dataset_with_vectors_becomes_rows_in_the_range_of_an_agent(tmp_path):
    rows = read(write_minari(tmp_path / "minari", TwoParts), TwoParts, vectors=("place",))
    observations, actions, _ = play(TwoParts)
    assert np.allclose(rows.actions[:-1], actions / 2.0, atol=1e-6)
    assert np.allclose(rows.labels, [each["place"] for each in observations])


def test_vector_of_a_minari_dataset_that_looks_like_a_picture_stays_a_vector(tmp_path):
    class Grid(TwoParts):
        observation_space = spaces.Dict({"camera": PICTURE, "place": spaces.Box(0.0, 1.0, (2, 2), np.float32)})

        def picture(self):
            seen = super().picture()
            return {**seen, "place": np.full((2, 2), 0.5 + 0.5 * seen["place"][0], np.float32)}

    rows = read(write_minari(tmp_path / "minari", Grid), Grid, vectors=("place",))
    assert np.allclose(rows.labels, [each["place"].ravel() for each in play(Grid)[0]])


def test_minari_dataset_with_a_nested_observation_is_read_by_its_picture(tmp_path):
    class Kitchen(TwoParts):
        observation_space = spaces.Dict(
            {"camera": PICTURE, "goal": spaces.Dict({name: spaces.Box(0.0, 1.0, (2,)) for name in ("kettle", "slide")})}
        )

        def picture(self):
            return {"camera": super().picture()["camera"], "goal": {"kettle": np.ones(2), "slide": np.zeros(2)}}

    def stack(name):
        return np.stack([each["goal"][name] for each in play(Kitchen)[0]])

    cameras = np.stack([each["camera"] for each in play(Kitchen)[0]])
    observations = {"camera": cameras, "goal": {"kettle": stack("kettle"), "slide": stack("slide")}}
    rows = read(write_minari(tmp_path / "minari", Kitchen, 1, changes={"observations": observations}), TwoParts)
    assert np.array_equal(rows.frames, [resize(picture, 64) for picture in cameras])


def test_terminal_state_ends_the_rows_of_an_episode(tmp_path):
    rows = read(write_minari(tmp_path / "minari", terminated=True))
    assert np.flatnonzero(rows.continues == 0.0).tolist() == [19]


def test_pictures_of_another_size_are_resized_as_those_of_the_environment(tmp_path):
    rows = read(write_minari(tmp_path / "minari"), frame_size=84)
    assert np.array_equal(rows.frames, [resize(picture, 84) for picture in play(Dot)[0]])


def test_minari_pictures_that_jpeg_has_packed_are_read(tmp_path):
    class Large(Dot):
        observation_space = spaces.Box(0, 255, (64, 64, 3), np.uint8)

        def picture(self):
            return resize(super().picture(), 64)

    rows = read(write_minari(tmp_path / "minari", Large, jpeg_encoding=True), Large)
    assert np.abs(rows.frames.astype(float) - play(Large)[0]).mean() < 8.0


@pytest.mark.parametrize("video", [True, False])
def test_lerobot_dataset_becomes_rows_without_the_last_action(video, tmp_path):
    rows = read(write_lerobot(tmp_path / "lerobot", video=video), TwoParts, index=1, vectors=("place",))
    observations, actions, rewards = play(TwoParts, seed=1)
    wanted = np.stack([resize(each["camera"], 64) for each in observations[:20]]).astype(float)
    assert rows.frames.shape == (20, 64, 64, 3)
    errors = np.abs(rows.frames - wanted).mean(axis=(1, 2, 3))
    assert errors.max() < (6.0 if video else 1e-9)  # the picture of another time differs by 15 and more
    assert np.allclose(rows.actions[:-1], actions[:19] / 2.0, atol=1e-6)
    assert np.allclose(rows.rewards[:-1], rewards[:19]) and rows.continues.all()
    assert np.allclose(rows.labels, [each["place"] for each in observations[:20]])


OTHER = spaces.Box(-1.0, 1.0, (2,), np.float32)
REFUSED = {
    "other range": ({}, {"kind": TwoParts}, r"has actions of 1 number, -1 to 1, and the environment takes of 1 number"),
    "state alone": (
        {"observation_space": OTHER, "changes": {"observations": np.zeros((21, 2), np.float32)}},
        {},
        r"holds no pictures, only picture \(2,\): record it again with pictures .*AddRenderObservation",
    ),
    "other actions": (
        {"action_space": OTHER, "changes": {"actions": np.zeros((20, 2), np.float32)}},
        {},
        "has actions of 2 numbers, and the environment takes 1",
    ),
    "unknown range": (
        {
            "action_space": spaces.Box(-np.inf, np.inf, (1,), np.float32),
            "changes": {"actions": np.full((20, 1), 1.5, np.float32)},
        },
        {},
        "an action of episode 0 is 1.5, and the environment takes of 1 number, -1 to 1: the units differ",
    ),
    "action repeat": ({}, {"action_repeat": 2}, "one action for every 1 step .* give --env.action_repeat 1"),
    "no such vector": ({}, {"kind": TwoParts, "vectors": ("place",)}, r"has the vectors none, .* names place \(1\)"),
    "reward": ({"changes": {"rewards": np.full(20, np.inf)}}, {}, "rewards of episode 0 must be finite"),
    "lengths": ({"changes": {"observations": np.zeros((20, 16, 16, 3), np.uint8)}}, {}, "must have 20 actions and one"),
}


@pytest.mark.parametrize("given", REFUSED.values(), ids=REFUSED)
def test_recording_that_does_not_fit_is_refused_in_one_line(given, tmp_path):
    written, settings, message = given
    with pytest.raises(UserError, match=message) as error:
        read(write_minari(tmp_path / "minari", episodes=1, **written), **settings)
    assert "\n" not in str(error.value)


def test_several_pictures_of_other_names_are_refused(tmp_path):
    class TwoViews(Dot):
        observation_space = spaces.Dict({"left": PICTURE, "right": PICTURE})

        def picture(self):
            return {"left": super().picture(), "right": super().picture()}

    with pytest.raises(UserError, match="shows picture, and the environment left, right: choose pictures"):
        read(write_minari(tmp_path / "minari"), TwoViews)
    rows = read(write_minari(tmp_path / "views", TwoViews), TwoViews, cameras=("right",))
    assert rows.frames.shape[1:] == (64, 64, 3)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"codebase_version": "v2.1"}, r"has format v2\.1 of LeRobot, and v3 is read"),
        ({"features": {}}, "has no actions: .* a feature 'action'"),
        ({"features": {"action": {"dtype": "float32", "shape": [1]}}}, "has no rewards: .* 'next.reward'"),
        ({"fps": "many"}, "cannot be read as a LeRobot dataset"),
    ],
)
def test_lerobot_dataset_of_another_form_is_refused(changes, message, tmp_path):
    folder = write_lerobot(tmp_path / "lerobot", video=False, changes=changes)
    with pytest.raises(UserError, match=message):
        open_recordings([str(folder)])


@pytest.mark.parametrize("is_short", [True, False])
def test_lerobot_table_with_other_rows_than_its_film_is_refused(is_short, tmp_path):
    folder = write_lerobot(tmp_path / "lerobot")
    info = json.loads((folder / "meta" / "info.json").read_text())
    del info["features"]["observation.place"]
    (folder / "meta" / "info.json").write_text(json.dumps(info))
    path = folder / "data" / "chunk-000" / "file-000.parquet"
    table = pyarrow.parquet.read_table(path)  # the last row of the last episode comes first
    pyarrow.parquet.write_table(table[1:] if is_short else pyarrow.concat_tables([table, table[:1]]), path)
    (recording,) = open_recordings([str(folder)])
    with pytest.raises(UserError, match="is damaged: episode 1 must have 20 rows and pictures"):
        recording.read(1)


def test_names_of_no_recording_are_refused(tmp_path):
    (tmp_path / "text.hdf5").write_text("no HDF5")
    (tmp_path / "empty").mkdir()
    (tmp_path / "half" / "data").mkdir(parents=True)
    (tmp_path / "half" / "data" / "metadata.json").write_text('{"total_episodes": 1}')
    for name, message in {
        "missing": "there is no ",
        "text.hdf5": "is no HDF5 file, or is damaged",
        "empty": "holds no recorded episodes: neither files",
        "half": "cannot be read as a Minari dataset: metadata.json lacks observation_space",
    }.items():
        with pytest.raises(UserError, match=message):
            open_recordings([str(tmp_path / name)])


@pytest.mark.parametrize("place", ["{folder}/../private.png", "../private.png", "a/../../private.png"])
def test_lerobot_dataset_that_names_a_file_outside_of_its_folder_is_refused(tmp_path, place):
    cv2.imwrite(str(tmp_path / "private.png"), np.full((64, 64, 3), 77, np.uint8))
    folder = write_lerobot(tmp_path / "dataset", video=False)
    path = folder / "data" / "chunk-000" / "file-000.parquet"
    rows = pyarrow.parquet.read_table(path).to_pylist()
    for row in rows:
        row["observation.images.camera"] = {"bytes": None, "path": place.format(folder=folder)}
    pyarrow.parquet.write_table(pyarrow.Table.from_pylist(rows), path)
    with pytest.raises(UserError, match="which is outside of its folder"):
        read(folder, TwoParts)


@pytest.mark.parametrize("name", ["data_path", "video_path"])
def test_lerobot_tables_and_videos_lie_in_its_folder(tmp_path, name):
    folder = write_lerobot(tmp_path / "dataset", changes={name: "/etc/hostname"})
    with pytest.raises(UserError, match="names /etc/hostname, which is outside of its folder"):
        read(folder, TwoParts)
