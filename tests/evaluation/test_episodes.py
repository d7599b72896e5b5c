"""Closed-loop episodes: starts depend on the seed alone; rewards, frames and decision times are counted."""

import json
import math
import time

import gymnasium
import numpy as np
import pytest

from latentplan.config import UserError
from latentplan.evaluation.episodes import episode_seed, evaluate_agent, iterate_episodes, run_episodes
from latentplan.evaluation.statistics import summarize


class ClockEnv(gymnasium.Env):
    """The pixels hold the time since a start drawn from the seed; the reward is the action."""

    def __init__(self, length=5, terminates=False):
        self.observation_space = gymnasium.spaces.Box(0, 255, (64, 64, 3), np.uint8)
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (1,), np.float32)
        self.length, self.terminates = length, terminates

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.start, self.time = int(self.np_random.integers(100)), 0
        return self._frame(), {"env_frames": 0}

    def step(self, action):
        self.time += 1
        over = self.time == self.length
        terminated, truncated = over and self.terminates, over and not self.terminates
        return self._frame(), float(action[0]), terminated, truncated, {"env_frames": 4}

    def _frame(self):
        return np.full((64, 64, 3), self.start + self.time, np.uint8)


class NoisyAgent:
    """Adds noise from its random stream to a constant, and keeps the times of the frames since the last reset."""

    def __init__(self, constant=0.0):
        self.constant, self.seen = constant, None

    def seed(self, seed):
        self.rng = np.random.default_rng(seed)

    def reset(self):
        self.seen = []

    def act(self, frame):
        self.seen.append(int(frame[0, 0, 0]))
        return np.float32([self.constant + 0.1 * self.rng.uniform(-1, 1)])


def first_frames(env, agent, seeds):
    starts = []
    run_episodes(env, agent, seeds, on_step=lambda step: step.decision == 0 and starts.append(step.frame[0, 0, 0]))
    return starts


def returns_of(episodes):
    return [episode.total_return for episode in episodes]


def test_episode_seed_depends_on_seed_and_index_only():
    seeds = [episode_seed(seed, index) for seed in range(5) for index in range(20)]
    assert len(set(seeds)) == 100
    assert seeds == [episode_seed(seed, index) for seed in range(5) for index in range(20)]


def test_episode_seed_fits_into_32_bits():
    assert all(0 <= episode_seed(0, index) < 2**32 for index in range(1000))


def test_run_episodes_gives_all_agents_the_same_starts():
    seeds = [episode_seed(0, index) for index in range(4)]
    starts = first_frames(ClockEnv(), NoisyAgent(), seeds)
    assert starts == first_frames(ClockEnv(length=9), NoisyAgent(0.5), seeds)
    assert len(set(starts)) > 1


def test_run_episodes_plays_each_episode_independently_of_earlier_ones():
    seeds = [episode_seed(3, index) for index in range(4)]
    env, agent = ClockEnv(), NoisyAgent()
    together = returns_of(run_episodes(env, agent, seeds))
    alone = [returns_of(run_episodes(env, agent, [seed]))[0] for seed in reversed(seeds)]
    assert together == alone[::-1]


def test_run_episodes_seeds_the_agent_with_another_seed_than_the_start():
    class Recorder(NoisyAgent):
        def seed(self, seed):
            self.given = seed
            super().seed(seed)

    agent = Recorder()
    run_episodes(ClockEnv(), agent, [7])
    assert agent.given != 7


def test_run_episodes_shows_the_agent_every_frame_but_the_last_in_order():
    agent = NoisyAgent()
    run_episodes(ClockEnv(length=6), agent, [1])
    assert agent.seen == list(range(agent.seen[0], agent.seen[0] + 6))


@pytest.mark.parametrize("terminates", [False, True])
def test_run_episodes_ends_an_episode_when_the_environment_does(terminates):
    (episode,) = run_episodes(ClockEnv(length=7, terminates=terminates), NoisyAgent(), [0])
    assert (episode.num_decisions, episode.env_frames, episode.decision_ms.shape) == (7, 28, (7,))


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_run_episodes_refuses_rewards_that_are_not_finite(value):
    with pytest.raises(UserError, match="not finite"):
        run_episodes(ClockEnv(), NoisyAgent(value), [0])


@pytest.mark.parametrize("reward", [None, "high", np.zeros(2)])
def test_reward_that_is_no_number_is_named(monkeypatch, reward):
    monkeypatch.setattr(ClockEnv, "step", lambda env, action: (env._frame(), reward, False, True, {}))
    with pytest.raises(UserError, match="reward that is no number"):
        run_episodes(ClockEnv(), NoisyAgent(), [0])


def test_evaluate_agent_refuses_vector_environments_before_it_plays():
    with pytest.raises(UserError, match="one environment, not a vector environment"):
        evaluate_agent(NoisyAgent(), gymnasium.vector.SyncVectorEnv([ClockEnv]), seed=0, episodes=1)


def test_evaluate_agent_gives_plain_values_for_any_seed_and_agent():
    agent = NoisyAgent()
    agent.last_source = "policy"  # a word of the user's own
    result = evaluate_agent(agent, ClockEnv(length=4), seed=np.int64(3), episodes=1)
    assert json.loads(json.dumps(result))["action_source"] == {"plan": 0, "tail": 0, "actor": 4}


def test_evaluate_agent_refuses_a_seed_that_is_no_whole_number():
    with pytest.raises(TypeError):
        evaluate_agent(NoisyAgent(), ClockEnv(), seed=3.5, episodes=1)


def test_evaluate_agent_summarizes_the_episodes_of_its_seeds():
    result = evaluate_agent(NoisyAgent(), ClockEnv(), seed=3, episodes=2)
    played = run_episodes(ClockEnv(), NoisyAgent(), [episode_seed(3, 0), episode_seed(3, 1)])
    assert (result["seed"], result["episodes"], result["returns"]) == (3, 2, returns_of(played))
    assert result.keys() == {"seed", *summarize(played)}
    with pytest.raises(ValueError, match="at least one"):
        evaluate_agent(NoisyAgent(), ClockEnv(), seed=3, episodes=0)


def test_on_step_gets_the_return_before_each_decision_and_at_the_end():
    steps = []
    (episode,) = run_episodes(ClockEnv(length=3), NoisyAgent(1.0), [0], on_step=steps.append)
    assert [step.decision for step in steps] == [0, 1, 2, 3]
    assert [step.action is None for step in steps] == [False, False, False, True]
    assert steps[0].total_return == 0.0
    assert np.diff([step.total_return for step in steps]) == pytest.approx([step.action[0] for step in steps[:-1]])
    assert steps[-1].total_return == episode.total_return


def test_decision_ms_excludes_simulator_and_callback():
    class SlowEnv(ClockEnv):
        def step(self, action):
            time.sleep(0.05)
            return super().step(action)

    (episode,) = run_episodes(SlowEnv(), NoisyAgent(), [0], on_step=lambda step: time.sleep(0.05))
    assert np.median(episode.decision_ms) < 25.0  # a decision time with one of the two sleeps would be 50 ms


def test_iterate_episodes_gives_an_episode_before_the_next_begins():
    class Impatient(NoisyAgent):
        def act(self, frame):
            if len(finished) == 2:
                raise KeyboardInterrupt
            return super().act(frame)

    finished = []
    with pytest.raises(KeyboardInterrupt):
        for episode in iterate_episodes(ClockEnv(), Impatient(), [0, 1, 2]):
            finished.append(episode)
    assert len(finished) == 2
