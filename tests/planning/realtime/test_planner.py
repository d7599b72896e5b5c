"""A background planner: the loop never waits, errors reach the loop, and no process or thread is left behind."""

import multiprocessing
import os
import pickle
import signal
import sys
import threading
import time
from dataclasses import dataclass, replace
from typing import NamedTuple

import pytest
import torch

from latentplan.planning import BackgroundPlanner, CEMPlanner, FunctionModel, PlanScheduler, rate_limit
from tests.planning.realtime.integrator import dynamics, policy, reward, wait_for_plan

STATE = torch.tensor([[1.0]])
CEM = CEMPlanner(action_dim=1, horizon=4, num_samples=16, num_elites=4, num_iterations=2)
STARTING_SECONDS = 60.0  # a process imports torch first
# A loop that waits for a hanging search takes minutes. Delays of a busy machine are far below this limit.
DECISION_SECONDS = 1.0


class StubbornError(Exception):
    """An error that cannot be unpickled from its message alone."""

    def __init__(self, first, second):
        super().__init__(f"{first} and {second}")


THROWS, THROWS_ODDLY, DIES, HANGS, HANGS_ON, HOLDS_A_LAMBDA = (torch.tensor([[value]]) for value in range(101, 107))


@dataclass
class Scripted:
    """A planner that fails in the way that the state names, or as `trouble` names after `num_good` searches."""

    trouble: torch.Tensor | None = None
    num_good: int = 0
    num_searches: int = 0

    def plan(self, model, state, previous=None, *, objective=None, constraints=(), generator=None):
        self.num_searches += 1
        cause = self.trouble if self.trouble is not None and self.num_searches > self.num_good else state
        if torch.equal(cause, THROWS):
            raise KeyError("no such plan")
        if torch.equal(cause, HOLDS_A_LAMBDA):
            plan = CEM.plan(model, state, previous, generator=generator)
            return replace(plan, info={**plan.info, "best": lambda: 0})
        if torch.equal(cause, THROWS_ODDLY):
            raise StubbornError("this", "that")
        if torch.equal(cause, DIES):
            os._exit(7)
        if torch.equal(cause, HANGS_ON):
            signal.signal(signal.SIGTERM, signal.SIG_IGN)
        if torch.equal(cause, HANGS) or torch.equal(cause, HANGS_ON):
            time.sleep(600.0)
        time.sleep(0.01 * (self.num_searches % 4))
        return CEM.plan(model, state, previous, generator=generator)


MODEL = FunctionModel(dynamics, reward, policy=policy)


@pytest.fixture(scope="module")
def process():
    """A background planner in a process, interrupted while it starts; shared, because a process imports torch first."""
    with BackgroundPlanner(Scripted(), MODEL) as background:
        os.kill(background.process.pid, signal.SIGINT)
        assert background.wait_until_ready(STARTING_SECONDS)
        yield background


@pytest.fixture(scope="module")
def thread():
    """A background planner in a thread, ready and shared."""
    with start(Scripted(), "thread") as background:
        yield background


@pytest.fixture(params=["process", "thread"])
def running(request):
    """A background planner that is ready, of both kinds."""
    return request.getfixturevalue(request.param)


def start(planner, worker="process"):
    background = BackgroundPlanner(planner, MODEL, worker=worker)
    assert background.wait_until_ready(STARTING_SECONDS)
    return background


def drive(background, num, tick_seconds, check=lambda decision: None):
    """Makes decisions at a rate; returns their sources and the longest duration of one."""
    scheduler, state, sources, longest = PlanScheduler(CEM, MODEL, background), STATE, [], 0.0
    for _ in range(num):
        started = time.monotonic()
        decision = scheduler.decide(state)
        longest = max(longest, time.monotonic() - started)
        assert torch.isfinite(decision.action).all() and (decision.action.abs() <= 1.0).all()
        sources.append(decision.source)
        state = dynamics(state, decision.action)
        time.sleep(tick_seconds)
    return sources, longest


def test_poll_returns_the_plan_of_a_direct_search_with_its_tick(running):
    assert running.poll() is None and running.is_idle
    assert running.request(STATE, 7, seed=3)
    assert not running.is_idle and not running.request(STATE, 8)
    tick, plan = wait_for_plan(running)
    assert tick == 7 and running.is_idle and running.poll() is None
    expected = CEM.plan(MODEL, STATE, generator=torch.Generator().manual_seed(3))
    torch.testing.assert_close(plan.actions, expected.actions)
    assert running.request(STATE, 9, previous=plan, seed=4)
    warm = CEM.plan(MODEL, STATE, expected, generator=torch.Generator().manual_seed(4))
    torch.testing.assert_close(wait_for_plan(running)[1].actions, warm.actions)


def test_decide_returns_at_once_while_plans_are_slow_and_jitter(running):
    sources, longest = drive(running, 60, 0.01)
    assert longest < DECISION_SECONDS
    assert {"plan", "tail"} & set(sources)
    while not running.is_idle:
        wait_for_plan(running)


def test_poll_raises_the_search_error_with_type_message_and_traceback(running):
    for _ in range(2):  # the worker goes on
        assert running.request(THROWS, 0)
        with pytest.raises(KeyError, match="no such plan") as caught:
            wait_for_plan(running)
        assert "test_planner.py" in str(caught.value.__cause__)


def test_poll_keeps_name_and_message_of_an_error_that_cannot_be_pickled(running):
    running.request(THROWS_ODDLY, 0)
    with pytest.raises(RuntimeError, match="StubbornError: this and that"):
        wait_for_plan(running)


def test_scheduler_raises_a_search_error_and_the_executor_is_idle_again():
    with start(Scripted(THROWS, num_good=2), "thread") as background:
        with pytest.raises(KeyError, match="no such plan"):
            drive(background, 400, 0.005)
        assert background.is_idle


def test_decide_returns_tail_then_actor_when_the_search_hangs_and_close_kills_it():
    """The search even ignores the request to terminate."""
    background = start(Scripted(HANGS_ON, num_good=4))
    sources, longest = drive(background, 80, 0.02)
    assert longest < DECISION_SECONDS
    assert {"plan", "tail"} & set(sources) and sources[-20:] == ["actor"] * 20
    process, started = background.process, time.monotonic()
    background.close()
    assert time.monotonic() - started < 5.0
    assert not process.is_alive() and process.exitcode == -signal.SIGKILL
    assert not background.is_idle and not background.request(STATE, 0) and background.poll() is None
    background.close()  # once more does no harm


def test_poll_raises_once_when_the_process_died():
    with BackgroundPlanner(Scripted(), MODEL) as background:
        assert background.request(DIES, 0)  # kept until the worker is ready
        with pytest.raises(RuntimeError, match=r"ended unexpectedly \(exit code 7\)"):
            wait_for_plan(background, STARTING_SECONDS)
        assert background.poll() is None and not background.is_idle


@pytest.mark.parametrize("worker", ["process", "thread"])
def test_close_ends_process_and_thread(worker):
    before = set(threading.enumerate())
    background = BackgroundPlanner(CEM, MODEL, worker=worker)
    background.request(STATE, 0)
    process = background.process
    background.close()
    assert set(threading.enumerate()) <= before
    assert process not in multiprocessing.active_children()


def test_process_ends_when_its_planner_is_dropped():
    background = BackgroundPlanner(CEM, MODEL)
    process = background.process
    del background
    assert not process.is_alive()


def test_process_survives_an_interrupt_while_it_starts(process):
    assert process.process.is_alive()
    process.request(STATE, 0)
    assert wait_for_plan(process)[0] == 0


@pytest.mark.skipif(not hasattr(os, "fork"), reason="forks")
def test_close_in_a_fork_leaves_the_worker_running(process):
    child = os.fork()
    if child == 0:
        process.close()
        os._exit(0)
    os.waitpid(child, 0)
    process.request(STATE, 0)
    assert wait_for_plan(process)[0] == 0


class Exits:
    def plan(self, *_, **__):
        sys.exit(3)


def test_poll_raises_when_a_search_exits_its_thread():
    with start(Exits(), "thread") as background:
        for _ in range(2):
            background.request(STATE, 0)
            with pytest.raises(RuntimeError, match="SystemExit: 3"):
                wait_for_plan(background)


def refuse_to_load():
    raise AttributeError("there is no such class here")


class Unreadable(NamedTuple):
    """A state that another process cannot unpickle, as one of a class below a main guard."""

    x: torch.Tensor

    def __reduce__(self):
        return refuse_to_load, ()


def test_poll_raises_when_a_state_cannot_be_unpickled_and_the_planner_goes_on(process):
    process.request(Unreadable(STATE), 0)
    with pytest.raises(AttributeError, match="no such class"):
        wait_for_plan(process)
    assert process.request(STATE, 1)
    assert wait_for_plan(process)[0] == 1


def test_plan_that_cannot_be_pickled_is_an_error_and_the_planner_goes_on(process):
    process.request(HOLDS_A_LAMBDA, 0)
    with pytest.raises((AttributeError, pickle.PicklingError)):
        wait_for_plan(process)
    assert process.request(STATE, 1)
    assert wait_for_plan(process)[0] == 1


def test_program_ends_without_close_and_leaves_no_process(run_python, tmp_path):
    (tmp_path / "program.py").write_text(
        "import torch\n"
        "from latentplan.planning import BackgroundPlanner\n"
        "from tests.planning.realtime.test_planner import HANGS, MODEL, Scripted\n"
        "if __name__ == '__main__':\n"
        "    background = BackgroundPlanner(Scripted(), MODEL)\n"
        "    background.wait_until_ready(60.0)\n"
        "    background.request(HANGS, 0)\n"
        "    print(background.process.pid)\n"
    )
    finished = run_python(tmp_path / "program.py")
    assert finished.returncode == 0 and finished.stderr == ""
    with pytest.raises(ProcessLookupError):
        os.kill(int(finished.stdout), 0)


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads /proc")
def test_background_planner_spawns_its_process(process):
    command = open(f"/proc/{process.process.pid}/cmdline").read()
    assert "spawn_main" in command
    assert type(process.process).__name__ == "SpawnProcess" and process.process.daemon


def test_background_planner_refuses_a_model_that_cannot_be_pickled_and_an_unknown_worker():
    model = FunctionModel(lambda state, action: state, reward)
    with pytest.raises(TypeError, match="worker='thread'"):
        BackgroundPlanner(CEM, model)
    with BackgroundPlanner(CEM, model, worker="thread") as background:
        background.request(STATE, 0)
        assert wait_for_plan(background)[0] == 0
    with pytest.raises(ValueError, match="process, thread"):
        BackgroundPlanner(CEM, MODEL, worker="fork")


def test_background_planner_names_a_constraint_that_is_no_sequence(thread):
    with pytest.raises(TypeError, match="constraints must be a sequence of functions.*, got one function"):
        BackgroundPlanner(CEM, MODEL, constraints=rate_limit(0.1), worker="thread")
    with pytest.raises(TypeError, match="constraints must be a sequence of functions.*, got one function"):
        thread.set_objective(constraints=rate_limit(0.1))


def test_state_that_is_refused_leaves_the_planner_idle_and_keeps_the_objective():
    planner = CEMPlanner(action_dim=1, horizon=3, num_samples=256, num_elites=16)
    with BackgroundPlanner(planner, FunctionModel(dynamics, reward), worker="thread") as background:
        background.set_objective(lambda rollout: rollout.actions[:, 0, 0])
        with pytest.raises(ValueError, match="the same rows"):
            background.request({"a": torch.zeros(2, 1), "b": torch.zeros(3, 1)}, 0)
        assert background.is_idle and background.request(torch.zeros(2, 1), 1, seed=0)
        _, plan = wait_for_plan(background)
        assert (plan.actions[:, 0] > 0.5).all()
