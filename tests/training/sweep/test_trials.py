"""A trial of a sweep, without Ray: what it reports, and whether its run has ended."""

import contextlib
import json
from dataclasses import replace
from types import SimpleNamespace

import pytest

from latentplan.config import RunConfig, UserError
from latentplan.config.run_results import note_state
from latentplan.training.sweep import trials
from latentplan.training.sweep.trials import Sweep, Trial

HEADER = "env_frames,updates,minutes,planner_return,actor_return\n"


@pytest.fixture
def sweep(tmp_path):
    given = {"run": {"frames": 90, "device": "cpu"}}
    return Sweep(tmp_path, {}, 1, 1, {}, given, "cpu", None, None, program=("-c", "pass"))


def test_trial_reports_each_evaluation_once_when_a_file_cannot_be_read_for_a_while(sweep, monkeypatch):
    folder, reports = sweep.folder / "abc", []
    rows = [HEADER, *(f"{frames},1,0.1,{frames},1\n" for frames in (10, 20, 30))]
    states = [("".join(rows[:3]), None), ("damaged\n1\n", None), ("".join(rows), None), ("".join(rows), 0)]

    class Process:
        def poll(self):
            text, code = states.pop(0)
            (folder / "metrics.csv").write_text(text)
            return code

    context = SimpleNamespace(get_trial_id=lambda: "abc", get_trial_dir=lambda: "tune/run_trial_abc_1_x")
    tune = SimpleNamespace(get_context=lambda: context, report=reports.append)
    monkeypatch.setattr(trials, "import_extra", lambda *_: tune)
    monkeypatch.setattr(trials, "_training", lambda *_: contextlib.nullcontext(Process()))
    monkeypatch.setattr(trials, "POLL_S", 0.0)
    trials.run_trial({}, sweep)
    assert [report["env_frames"] for report in reports] == [10, 20, 30]


def test_trial_whose_values_contradict_each_other_fails_with_the_reason(sweep, monkeypatch):
    context = SimpleNamespace(get_trial_id=lambda: "abc", get_trial_dir=lambda: "tune/run_trial_abc_1_x")
    monkeypatch.setattr(trials, "import_extra", lambda *_: SimpleNamespace(get_context=lambda: context))
    values = {"planner.num_elites": 100, "planner.num_samples": 64}
    with pytest.raises(UserError, match=r"num_elites \(100\) must not exceed num_samples \(64\)"):
        trials.run_trial(values, sweep)
    assert trials.last_line(sweep.folder / "abc").startswith("error: planner.num_elites (100) must not exceed")
    assert trials.list_trials(sweep.folder) == [Trial(1, values, "failed", None)]


@pytest.mark.parametrize("state", ["running", "stopped", "failed", "finished"])  # running: of a run that was killed
def test_run_goes_on_until_its_state_is_finished(sweep, state):
    """A run that was killed after its final evaluation has not saved what follows it."""
    (folder := sweep.folder / "abc").mkdir()
    clocks = {"env_frames": 90, "minutes": 0.1, "updates": 1}
    (folder / "final.json").write_text(json.dumps(clocks | {"planner": 1.0, "actor": 1.0}))
    note_state(folder, state)
    with trials._training(sweep, folder, sweep.folder / "settings.yaml") as process:
        assert (process is None) == (state == "finished")
        if process is not None:
            process.wait(20.0)


@pytest.mark.parametrize("change", [{"frames": 91}, {"seed": 1}, {"minutes": 3.0}, {"updates": 7}])
def test_sweep_does_not_go_on_with_another_budget_or_seed(sweep, change):
    trials._note(sweep, RunConfig(frames=90))
    trials._note(sweep, RunConfig(frames=90))
    with pytest.raises(UserError, match=rf"a sweep with other settings \({next(iter(change))}\)"):
        trials._note(sweep, replace(RunConfig(frames=90), **change))


def test_sweep_of_a_version_that_noted_less_goes_on(sweep):
    trials._note(sweep, RunConfig(frames=90, seed=3))
    path = sweep.folder / trials.SWEEP_FILE
    known = json.loads(path.read_text())
    path.write_text(json.dumps({name: known[name] for name in known if name not in ("seed", "minutes", "updates")}))
    trials._note(sweep, RunConfig(frames=90, seed=3))
