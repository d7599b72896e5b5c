"""Episodes in a world that goes on while the agent decides, with decisions of known durations."""

import time

import gymnasium
import numpy as np
import pytest

from latentplan.evaluation.clock import Latency, VirtualClock
from latentplan.evaluation.episodes import run_episodes
from latentplan.evaluation.timed import iterate_timed_episodes, summarize_timed

SUBSTEPS = 10


class TapeEnv:
    """The pixels hold the number of the period; the actions of all substeps are kept, and summed as reward."""

    def __init__(self, length=4, low=-1.0):
        self.action_space = gymnasium.spaces.Box(low, 1.0, (1,), np.float32)
        self.substeps_per_decision, self.length = SUBSTEPS, length

    def reset(self, *, seed=None):
        self.tape, self.period = [], 0
        return self._frame(), {}

    def step(self, action):
        return self.step_schedule([(action, SUBSTEPS)])

    def step_schedule(self, schedule):
        acted = [float(action[0]) for action, count in schedule for _ in range(count)]
        assert len(acted) == SUBSTEPS and all(count > 0 for _, count in schedule)
        self.tape.append(acted)
        self.period += 1
        return self._frame(), sum(acted), False, self.period == self.length, {"env_frames": 2}

    def _frame(self):
        return np.full((64, 64, 3), self.period, np.uint8)


class CountingAgent:
    """Returns the actions 1, 2, 3 and so on, and keeps the periods of the frames."""

    def seed(self, seed):
        pass

    def reset(self):
        self.seen = []

    def act(self, frame):
        self.seen.append(int(frame[0, 0, 0]))
        return np.float32([len(self.seen)])


def constant(milliseconds):
    return Latency("file", np.array([float(milliseconds)]), np.array([float(milliseconds)]))


def play(milliseconds, control_hz=20.0, length=4, on_step=None, env=None):
    """One episode with decisions of the given duration; a period lasts 50 ms by default."""
    env, agent = env or TapeEnv(length), CountingAgent()
    clock = VirtualClock(control_hz, constant(milliseconds))
    (episode,) = iterate_timed_episodes(env, agent, [0], clock, on_step=on_step)
    return env.tape, agent.seen, episode


def test_timed_episode_equals_a_plain_episode_when_decisions_take_no_time():
    tape, seen, episode = play(0.0)
    (waited,) = run_episodes(TapeEnv(), CountingAgent(), [0])
    assert tape == [[float(action)] * SUBSTEPS for action in (1, 2, 3, 4)]
    assert seen == [0, 1, 2, 3]
    assert (episode.total_return, episode.env_frames) == (waited.total_return, waited.env_frames)
    assert episode.deadline_misses == 0


def test_action_takes_effect_after_the_time_of_its_decision():
    tape, _, episode = play(15.0)  # 0.3 periods, 3 substeps of 5 ms
    assert tape == [[float(before)] * 3 + [before + 1.0] * 7 for before in range(4)]
    assert episode.deadline_misses == 0


@pytest.mark.parametrize(("milliseconds", "late"), [(0.4, 0), (2.4, 0), (2.6, 1), (5.0, 1), (48.0, 10), (50.0, 10)])
def test_action_takes_effect_at_the_nearest_substep(milliseconds, late):
    tape, _, episode = play(milliseconds)
    assert tape[0] == [0.0] * late + [1.0] * (SUBSTEPS - late)
    assert episode.deadline_misses == 0


@pytest.mark.parametrize("control_hz", [3.0, 7.0, 30.0, 49.0, 1000.0])
def test_decision_of_exactly_one_period_misses_no_deadline(control_hz):
    tape, seen, episode = play(1000.0 / control_hz, control_hz)
    assert seen == [0, 1, 2, 3]
    assert tape == [[float(action)] * SUBSTEPS for action in (0, 1, 2, 3)]
    assert episode.deadline_misses == 0


def test_decision_misses_a_deadline_by_any_part_of_a_substep():
    tape, seen, episode = play(51.0)
    assert (seen, episode.deadline_misses) == ([0, 2], 2)
    assert tape == [[0.0] * 10, [1.0] * 10, [1.0] * 10, [2.0] * 10]


def test_agent_decides_next_at_the_first_boundary_after_a_long_decision():
    tape, seen, episode = play(60.0, length=5)  # 12 substeps
    assert seen == [0, 2, 4]
    assert tape == [[0.0] * 10, [0.0] * 2 + [1.0] * 8, [1.0] * 10, [1.0] * 2 + [2.0] * 8, [2.0] * 10]
    assert (episode.deadline_misses, episode.num_decisions) == (2, 3)


def test_decision_of_three_periods_misses_two_deadlines():
    _, seen, episode = play(150.0, length=7)
    assert (seen, episode.deadline_misses) == ([0, 3, 6], 4)


def test_action_never_takes_effect_when_it_comes_after_the_end():
    tape, _, episode = play(1000.0)
    assert tape == [[0.0] * SUBSTEPS] * 4
    assert (episode.num_decisions, episode.deadline_misses) == (1, 3)


def test_zeros_clamped_into_the_bounds_hold_before_the_first_decision():
    tape, _, _ = play(15.0, env=TapeEnv(low=0.25))
    assert tape[0][:3] == [0.25] * 3


def test_action_is_delayed_by_more_substeps_when_the_period_is_shorter():
    slow, fast = (play(10.0, control_hz)[0][0] for control_hz in (10.0, 50.0))
    assert (slow.count(0.0), fast.count(0.0)) == (1, 5)


def test_on_step_is_called_at_every_period_and_at_the_end():
    steps = []
    play(60.0, length=5, on_step=steps.append)
    assert [step.decision for step in steps] == [0, 1, 2, 3, 4, 5]
    assert [step.frame[0, 0, 0] for step in steps] == [0, 1, 2, 3, 4, 5]
    assert [None if step.action is None else step.action[0] for step in steps] == [1, 1, 2, 2, 3, None]


def test_timed_episodes_repeat_with_their_seed_and_differ_between_seeds():
    spread = Latency("file", np.linspace(0.0, 120.0, 25), np.zeros(1))

    def played(seeds):
        clock = VirtualClock(20.0, spread)
        episodes = list(iterate_timed_episodes(TapeEnv(20), CountingAgent(), seeds, clock))
        return [(episode.total_return, episode.decision_ms.tolist()) for episode in episodes]

    both = played([1, 2])
    assert both == played([1, 2])
    assert both[0] != both[1]
    assert both[1:] == played([2])


def test_timed_episode_charges_measured_decisions_their_time():
    class Sleeper(CountingAgent):
        def act(self, frame):
            time.sleep(0.02)
            return super().act(frame)

    agent, env = Sleeper(), TapeEnv(length=3)
    (episode,) = iterate_timed_episodes(env, agent, [0], VirtualClock(100.0, Latency()))
    assert agent.seen == [0]  # more than two periods of 10 ms
    assert episode.decision_ms[0] >= 20.0
    assert episode.deadline_misses == 2


def test_summarize_timed_adds_the_figures_of_real_time():
    clock = VirtualClock(20.0, constant(60.0))
    summary = summarize_timed(list(iterate_timed_episodes(TapeEnv(5), CountingAgent(), [0, 1], clock)), clock)
    assert summary["episodes"] == 2
    assert summary["decision_ms"]["p50"] == 60.0
    assert (summary["control_hz"], summary["latency"], summary["deadline_misses"]) == (20.0, "file", 4)
    assert summary["action_source"] == {"plan": 0, "tail": 0, "actor": 6}
    assert summary["planned_fraction"] == 0.0
    assert summary["plan_age_ms"] is None
