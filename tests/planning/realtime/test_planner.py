"""A search beside the loop: the loop never waits, errors surface, and nothing is left behind."""

import multiprocessing
import os
import signal
import sys
import threading
import time
from dataclasses import dataclass

import pytest
import torch

from latentplan.planning import BackgroundPlanner, CEMPlanner, FunctionModel, PlanScheduler

STATE = torch.tensor([[1.0]])
CEM = CEMPlanner(action_dim=1, horizon=4, num_samples=16, num_elites=4, num_iterations=2)
STARTING_SECONDS = 60.0  # a process imports torch first
# A loop that waited for a search that hangs would take minutes; what a busy machine adds is far below this.
DECISION_SECONDS = 1.0


class StubbornError(Exception):
    """Cannot be rebuilt from its message alone."""

    def __init__(self, first, second):
        super().__init__(f"{first} and {second}")


THROWS, THROWS_ODDLY, DIES, HANGS, HANGS_ON = (torch.tensor([[value]]) for value in (101.0, 102.0, 103.0, 104.0, 105.0))


@dataclass
class Scripted:
    """The planner, after what some states make happen first, or every state after `num_good` searches."""

    trouble: torch.Tensor | None = None
    num_good: int = 0
    num_searches: int = 0

    def plan(self, model, state, previous=None, *, objective=None, constraints=(), generator=None):
        self.num_searches += 1
        cause = self.trouble if self.trouble is not None and self.num_searches > self.num_good else state
        if torch.equal(cause, THROWS):
            raise KeyError("no such plan")
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


def dynamics(state, action):
    return state + action


def reward(state, action):
    return -(state + action).square().sum(dim=1)


def policy(state, generator):
    return torch.full((len(state), 1), 0.05)


MODEL = FunctionModel(dynamics, reward, policy=policy)


@pytest.fixture(scope="module", params=["process", "thread"])
def running(request):
    """A background planner that is ready."""
    background = start(Scripted(), request.param)
    yield background
    background.close()


def start(planner, worker="process"):
    background = BackgroundPlanner(planner, MODEL, worker=worker)
    assert background.wait_until_ready(STARTING_SECONDS)
    return background


def wait_for_plan(background, seconds=20.0):
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        found = background.poll()
        if found is not None:
            return found
        time.sleep(0.002)
    raise AssertionError("no plan came")


def drive(background, num, tick_seconds, check=lambda decision: None):
    """Decisions at a rate; their sources, and the longest that one took."""
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


def test_a_plan_comes_back_with_its_tick_and_as_it_would_be_searched_here(running):
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


def test_the_loop_keeps_its_rate_while_plans_are_slow_and_jitter(running):
    sources, longest = drive(running, 60, 0.01)
    assert longest < DECISION_SECONDS
    assert {"plan", "tail"} & set(sources)
    while not running.is_idle:
        wait_for_plan(running)


def test_what_the_search_raises_surfaces_with_type_message_and_place(running):
    for _ in range(2):  # the worker goes on
        assert running.request(THROWS, 0)
        with pytest.raises(KeyError, match="no such plan") as caught:
            wait_for_plan(running)
        assert "test_planner.py" in str(caught.value.__cause__)


def test_an_error_that_cannot_travel_keeps_its_name_and_message(running):
    running.request(THROWS_ODDLY, 0)
    with pytest.raises(RuntimeError, match="StubbornError: this and that"):
        wait_for_plan(running)


def test_a_failure_reaches_the_loop_and_the_loop_can_go_on():
    with start(Scripted(THROWS, num_good=2), "thread") as background:
        with pytest.raises(KeyError, match="no such plan"):
            drive(background, 400, 0.005)
        assert background.is_idle


def test_a_hanging_search_leaves_the_loop_to_the_tail_and_the_actor_and_can_be_closed():
    background = start(Scripted(HANGS, num_good=4))
    sources, longest = drive(background, 80, 0.02)
    assert longest < DECISION_SECONDS
    assert {"plan", "tail"} & set(sources) and sources[-20:] == ["actor"] * 20
    process, started = background.process, time.monotonic()
    background.close()
    assert time.monotonic() - started < 5.0
    assert not process.is_alive() and process.exitcode is not None
    assert not background.is_idle and not background.request(STATE, 0) and background.poll() is None
    background.close()  # once more does no harm


def test_a_process_that_ignores_being_terminated_is_killed():
    background = start(Scripted())
    background.request(HANGS_ON, 0)
    time.sleep(0.5)
    background.close()
    assert background.process.exitcode == -signal.SIGKILL


def test_a_process_that_dies_is_reported_once():
    with BackgroundPlanner(Scripted(), MODEL) as background:
        assert background.request(DIES, 0)  # kept until the worker is ready
        with pytest.raises(RuntimeError, match=r"ended unexpectedly \(exit code 7\)"):
            wait_for_plan(background, STARTING_SECONDS)
        assert background.poll() is None and not background.is_idle


@pytest.mark.parametrize("worker", ["process", "thread"])
def test_closing_leaves_neither_process_nor_thread(worker):
    before = set(threading.enumerate())
    background = BackgroundPlanner(CEM, MODEL, worker=worker)
    background.request(STATE, 0)
    process = background.process
    background.close()
    assert set(threading.enumerate()) <= before
    assert process not in multiprocessing.active_children()


def test_a_planner_that_is_dropped_ends_its_process():
    background = BackgroundPlanner(CEM, MODEL)
    process = background.process
    del background
    assert not process.is_alive()


def test_an_interrupt_while_it_starts_is_left_to_the_loop():
    with BackgroundPlanner(CEM, MODEL) as background:
        os.kill(background.process.pid, signal.SIGINT)
        assert background.wait_until_ready(STARTING_SECONDS) and background.process.is_alive()
        background.request(STATE, 0)
        assert wait_for_plan(background)[0] == 0


@pytest.mark.skipif(not hasattr(os, "fork"), reason="forks")
def test_a_fork_leaves_the_worker_to_its_parent():
    with start(CEM) as background:
        child = os.fork()
        if child == 0:
            background.close()
            os._exit(0)
        os.waitpid(child, 0)
        background.request(STATE, 0)
        assert wait_for_plan(background)[0] == 0


class Leaves:
    def plan(self, *_, **__):
        sys.exit(3)


def test_a_search_that_leaves_its_thread_is_told_of():
    with start(Leaves(), "thread") as background:
        for _ in range(2):
            background.request(STATE, 0)
            with pytest.raises(RuntimeError, match="SystemExit: 3"):
                wait_for_plan(background)


def test_the_program_ends_though_nobody_closed_and_leaves_no_process(run_python, tmp_path):
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
def test_processes_are_spawned_not_forked():
    with BackgroundPlanner(CEM, MODEL) as background:
        background.wait_until_ready(60.0)  # a process that has not yet begun its program names none
        command = open(f"/proc/{background.process.pid}/cmdline").read()
        assert "spawn_main" in command
        assert type(background.process).__name__ == "SpawnProcess" and background.process.daemon


def test_what_cannot_be_sent_is_refused_with_the_way_out():
    model = FunctionModel(lambda state, action: state, reward)
    with pytest.raises(TypeError, match="worker='thread'"):
        BackgroundPlanner(CEM, model)
    with BackgroundPlanner(CEM, model, worker="thread") as background:
        background.request(STATE, 0)
        assert wait_for_plan(background)[0] == 0
    with pytest.raises(ValueError, match="process, thread"):
        BackgroundPlanner(CEM, MODEL, worker="fork")
