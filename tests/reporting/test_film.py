"""Films show the first episode of a rollout."""

from types import SimpleNamespace

import cv2
import gymnasium
import numpy as np
import pytest

from latentplan.reporting.film import filming, filming_if_possible


class SharpEnv(gymnasium.Env):
    """Renders green at any size."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 12.5}

    def render_large(self, size):
        return np.full((size, size, 3), (0, 200, 0), np.uint8)


class BlueAgent:
    steps_ahead = 6

    def imagine(self):
        return np.full((64, 64, 3), (0, 0, 200), np.uint8)


def moment(decision, episode=0, action=(0.0,)):
    frame = np.full((64, 64, 3), (200, 0, 0), np.uint8)
    return SimpleNamespace(episode=episode, decision=decision, total_return=1.5 * decision, frame=frame, action=action)


def film_of(path, env, planner, moments, every=1):
    with filming(path, env, planner, every=every) as film:
        for each in moments:
            film(each)
    capture = cv2.VideoCapture(str(path))
    frames = []
    while (result := capture.read())[0]:
        frames.append(result[1][..., ::-1].astype(int))
    return capture, frames


def share(frame, color):
    """Share of the picture that is nearly of a colour."""
    return (np.abs(frame - color).max(axis=2) < 30).mean()


def test_filming_films_the_first_episode_only(tmp_path):
    moments = [moment(0), moment(1), moment(2, action=None), moment(0, episode=1), moment(1, episode=1)]
    _, frames = film_of(tmp_path / "film.mp4", SharpEnv(), None, moments)
    assert len(frames) == 3


@pytest.mark.parametrize("every", [1, 2])
def test_filming_begins_anew_when_the_first_episode_is_played_again(tmp_path, every):
    played = [moment(0), moment(1), moment(2), moment(3, action=None)]
    aborted = [[moment(0), moment(1)], [moment(0)]]  # by faults of the environment
    _, frames = film_of(tmp_path / "film.mp4", SharpEnv(), None, [*sum(aborted, []), *played], every)
    _, expected = film_of(tmp_path / "whole.mp4", SharpEnv(), None, played, every)
    assert len(frames) == len(expected) and {path.name for path in tmp_path.iterdir()} == {"film.mp4", "whole.mp4"}


def test_filming_uses_the_frame_rate_of_the_environment(tmp_path):
    capture, _ = film_of(tmp_path / "film.mp4", SharpEnv(), None, [moment(0)])
    assert round(capture.get(cv2.CAP_PROP_FPS), 2) == 12.5


def test_filming_shows_the_large_picture_when_the_environment_renders_one(tmp_path):
    _, (frame,) = film_of(tmp_path / "film.mp4", SharpEnv(), None, [moment(0)])
    assert share(frame, (0, 200, 0)) > 0.35
    assert share(frame, (200, 0, 0)) == 0


def test_filming_shows_the_observation_when_there_is_no_large_picture(tmp_path):
    _, (frame,) = film_of(tmp_path / "film.mp4", gymnasium.Env(), None, [moment(0)])
    assert share(frame, (200, 0, 0)) > 0.35


def test_filming_shows_the_imagined_frame_until_the_episode_is_over(tmp_path):
    moments = [moment(0), moment(1), moment(2, action=None)]
    _, frames = film_of(tmp_path / "film.mp4", SharpEnv(), BlueAgent(), moments)
    shown = [share(frame, (0, 0, 200)) > 0.35 for frame in frames]
    assert shown == [True, True, False]


class Goals:
    objective_scores, clauses = (0.5,), (("height > 1.2", True),)


def test_filming_adds_a_strip_when_goals_are_scored(tmp_path):
    heights = []
    for name, goals in (("plain.mp4", None), ("goals.mp4", Goals)):
        with filming(tmp_path / name, SharpEnv(), None, goals=goals) as film:
            film(moment(0))
        heights.append(cv2.VideoCapture(str(tmp_path / name)).get(cv2.CAP_PROP_FRAME_HEIGHT))
    assert heights[1] - heights[0] == 104  # the strip and its gap


def test_filming_shows_the_end_of_the_episode_when_frames_are_skipped(tmp_path):
    moments = [*(moment(decision) for decision in range(9)), moment(9, action=None)]
    _, frames = film_of(tmp_path / "film.mp4", SharpEnv(), BlueAgent(), moments, every=4)
    shown = [share(frame, (0, 0, 200)) > 0.35 for frame in frames]
    assert shown == [True, True, True, False]  # decisions 0, 4 and 8, and the end of the episode


class TransparentEnv(SharpEnv):
    """Renders four channels, which the writer refuses."""

    def render_large(self, size):
        return np.zeros((size, size, 4), np.uint8)


@pytest.mark.parametrize(("name", "env"), [("missing/film.mp4", SharpEnv()), ("film.mp4", TransparentEnv())])
def test_filming_if_possible_warns_and_goes_on_when_the_film_fails(tmp_path, name, env):
    (tmp_path / "film.mp4").write_bytes(b"older")
    with pytest.warns(RuntimeWarning, match="no film at"), filming_if_possible(tmp_path / name, env, None) as film:
        for each in [moment(0), moment(1), moment(2, action=None)]:
            film(each)
    assert [path.name for path in tmp_path.iterdir()] == ["film.mp4"]
    assert (tmp_path / "film.mp4").read_bytes() == b"older"


def test_filming_if_possible_gives_no_warning_when_the_film_succeeds(tmp_path, recwarn):
    with filming_if_possible(tmp_path / "film.mp4", SharpEnv(), None) as film:
        film(moment(0))
    assert (tmp_path / "film.mp4").stat().st_size > 0
    assert not recwarn


def test_filming_if_possible_raises_errors_of_the_episode(tmp_path):
    with pytest.raises(ZeroDivisionError), filming_if_possible(tmp_path / "film.mp4", SharpEnv(), None) as film:
        film(moment(0))
        raise ZeroDivisionError
    assert not list(tmp_path.iterdir())
