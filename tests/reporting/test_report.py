"""Recording an episode changes nothing of it, and a report is one page that needs no other file."""

import re
from dataclasses import replace
from html.parser import HTMLParser
from types import SimpleNamespace

import gymnasium
import numpy as np
import pytest
import torch

from latentplan.agents.gated import GatedAgent
from latentplan.agents.planning import PlanningAgent
from latentplan.config import Config
from latentplan.config.run_results import Evaluation
from latentplan.config.writing import write_whole
from latentplan.evaluation.episodes import Step, run_episodes
from latentplan.reporting.page import Section, film, render_page, scrubber, table
from latentplan.reporting.recorder import (
    COMPARED_STEPS,
    EpisodeRecorder,
    GuardedRecorder,
    _mean_picture,
    choose_candidates,
)
from latentplan.reporting.report import ReportData, Returns, _goals, render_report, tile
from latentplan.reporting.svg import Labels, Line, plot_lines
from tests.agents.small_agents import CONFIG, make_model

DECISIONS = 40
VOID = {"meta", "link", "img", "input", "br"}


class NoisyEnv(gymnasium.Env):
    """Shows noise that depends on the seed and the actions."""

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps = 0
        return self.draw(), {}

    def step(self, action):
        self.steps += 1
        return self.draw(), float(action[0]), False, self.steps == DECISIONS, {}

    def draw(self):
        return self.np_random.integers(0, 255, (64, 64, 3), np.uint8)


class Elements(HTMLParser):
    """Checks that every element of a page is closed, and collects the addresses that it names."""

    def __init__(self):
        super().__init__()
        self.open, self.addresses, self.names = [], [], []

    def handle_starttag(self, tag, attributes):
        values = dict(attributes)
        self.addresses += [values[name] for name in ("src", "href", "xlink:href") if name in values]
        self.names += [values["id"]] if "id" in values else []
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


def play(make_agent, record):
    """The actions of one episode, and the recording if there is one."""
    agent, actions = make_agent(), []
    recorder = EpisodeRecorder(agent, DECISIONS) if record else None

    def watch(step):
        actions.append(step.action)
        if recorder is not None:
            recorder(step)

    run_episodes(NoisyEnv(), agent, [3], on_step=watch)
    return np.stack(actions[:-1]), recorder and recorder.recording


@pytest.mark.parametrize("kind", [PlanningAgent, GatedAgent])
def test_recorder_changes_no_action(kind):
    plain, _ = play(lambda: kind(make_model(), CONFIG, 0.95), record=False)
    recorded, recording = play(lambda: kind(make_model(), CONFIG, 0.95), record=True)
    assert np.array_equal(plain, recorded) and np.array_equal(recorded, np.stack(recording.actions))
    assert len(recording.surprise) == len(recording.actor_actions) == DECISIONS
    assert len(recording.totals) == DECISIONS + 1
    assert recording.inspections and recording.inspections[0].decision == 0


@pytest.fixture(scope="module")
def recording():
    return play(lambda: PlanningAgent(make_model(), CONFIG, 0.95), record=True)[1]


def test_recorder_sorts_candidates_from_elites(recording):
    assert [each.decision for each in recording.inspections] == [0, 10, 20, 30]
    first, *_, last = recording.inspections[0].search
    assert len(first.elites) == CONFIG.planner.num_elites
    assert first.elites.shape[1:] == first.mean.shape == (CONFIG.planner.horizon, 2)
    assert last.elite_return >= first.elite_return - 1e-4  # elites of an earlier iteration are no longer candidates
    assert first.elite_pictures.dtype == np.uint8


@pytest.mark.parametrize(("kind", "limit"), [(PlanningAgent, 5.0), (GatedAgent, None)])
def test_recording_has_the_surprise_limit_where_it_has_an_effect(kind, limit):
    settings = replace(CONFIG.planner, surprise_limit=5.0)
    assert play(lambda: kind(make_model(), CONFIG, 0.95, planner=settings), record=True)[1].surprise_limit == limit


def test_drawn_elites_are_those_of_the_search_and_no_other_candidate_is_one():
    elites = torch.tensor([[5.0, 0.0, torch.nan]])[:, :, None, None]
    iteration = SimpleNamespace(actions=torch.arange(4.0)[None, :, None, None], elites=elites)
    others, drawn = choose_candidates(iteration)
    assert others.ravel().tolist() == [1.0, 2.0, 3.0] and drawn.ravel().tolist() == [5.0, 0.0]
    others, drawn = choose_candidates(SimpleNamespace(actions=elites[:, :2], elites=elites))
    assert others.shape == (0, 1, 1) and len(drawn) == 2


def test_iteration_without_elites_is_drawn_with_its_candidates_alone(recording):
    iteration = SimpleNamespace(actions=torch.zeros(1, 4, 1, 1), elites=torch.full((1, 2, 1, 1), torch.nan))
    others, drawn = choose_candidates(iteration)
    assert others.shape == (4, 1, 1) and drawn.shape == (0, 1, 1)
    pictures = recording.strips[0].real[None]
    assert np.array_equal(_mean_picture(pictures), pictures[0]) and not _mean_picture(pictures[:0]).any()


def test_recorder_compares_imagination_with_the_frames_that_followed(recording):
    assert recording.picture_error.shape[1] == recording.reward_error.shape[1] == COMPARED_STEPS
    assert np.isfinite(recording.picture_error).all() and (recording.picture_error > 0.0).all()
    strip = recording.strips[0]
    assert strip.real.shape == strip.imagined.shape == (len(strip.steps), 32, 32, 3)


def test_imagination_along_the_plan_ends_as_the_film_shows_it():
    agent = PlanningAgent(make_model(), CONFIG, 0.95)
    agent.act(np.random.default_rng(0).integers(0, 255, (64, 64, 3), np.uint8))
    actions = agent.controller.plan.actions.float().numpy()
    pictures = agent.imagine_along([agent.belief()], actions, actions.shape[1]).pictures
    assert np.abs(pictures[0, -1].astype(int) - agent.imagine().astype(int)).max() <= 1  # rounding of two paths


def test_a_recorder_that_fails_warns_once_and_the_episode_goes_on():
    agent = PlanningAgent(make_model(), CONFIG, 0.95)
    agent.belief = None
    recorder = GuardedRecorder(EpisodeRecorder(agent, DECISIONS))
    with pytest.warns(RuntimeWarning, match="nothing of this episode") as caught:
        episode = run_episodes(NoisyEnv(), agent, [3], on_step=recorder)[0]
    assert len(caught) == 1 and episode.num_decisions == DECISIONS and recorder.recording is None
    assert agent.controller.keep is None


@pytest.fixture(scope="module")
def page(recording, tmp_path_factory):
    path = tmp_path_factory.mktemp("film") / "film.webm"
    path.write_bytes(b"film")
    recording.clauses = {"cart < 0.5": [True] * DECISIONS}
    recording.objective_scores = [0.5] * DECISIONS
    data = ReportData(
        "cartpole-swingup",
        Config(),
        [Returns("planner", [1.0, 2.0], (0.0, 3.0)), Returns("actor", [1.0], (np.nan, np.nan))],
        path,
        [Evaluation(1000, 1.0, 10.0, 5.0, 10), Evaluation(2000, 2.0, 20.0, 15.0, 20)],
        recording,
        np.linspace(1.0, 9.0, 50),
        {"period of control": 5.0},
        {"command": "eval.py <&>", "libraries": {"torch": "1"}},
    )
    return render_report(data)


def test_report_is_well_formed_and_names_no_other_file(page):
    elements = Elements()
    elements.feed(page)
    assert elements.open == []
    assert len(elements.names) == len(set(elements.names))
    for address in elements.addresses:
        assert address.startswith("data:") or address[1:] in elements.names, address
    assert not re.search(r"url\((?!#)", page) and "@import" not in page
    assert len(page) < 10_000_000


def test_report_shows_every_part_that_has_figures(page):
    for name in ("Film", "Returns", "Training curves", "Decision time", "Imagined against real", "Searches"):
        assert f"<h2>{name}</h2>" in page
    for name in ("Planner and actor", "Surprise and gate", "Goals", "Provenance"):
        assert f"<h2>{name}</h2>" in page
    assert "eval.py &lt;&amp;&gt;" in page and "DreamerV3" in page and "torch 1" in page


def test_report_with_a_name_that_is_not_utf8_can_be_written(tmp_path):
    page = render_report(ReportData("corridor", Config(), facts={"command": "eval --report caf\udce9.html"}))
    assert "caf\\udce9.html" in write_whole(tmp_path / "page.html", page).read_text()


def test_report_leaves_out_parts_without_figures():
    page = render_report(ReportData("corridor", Config()))
    assert re.findall("<h2>(.*?)</h2>", page) == ["Provenance"]


def test_figures_take_their_colours_from_the_theme():
    svg = plot_lines([Line("a", [0, 1], [0, 1], [0, 0], [1, 2])], Labels("a & b", "x", "y", [("level", 0.5)]))
    assert "var(--series-1)" in svg and "var(--ink)" in svg and 'aria-label="a &amp; b"' in svg
    assert not re.search(r"#[0-9a-f]{6}\b", svg)


@pytest.mark.parametrize(("values", "num_dots"), [([1.0], 1), ([1.0, 2.0], 0), ([1.0, np.nan, 2.0, 3.0], 1)])
def test_points_without_a_neighbour_are_dots(values, num_dots):
    svg = plot_lines([Line("", range(len(values)), values)], Labels("", "x", "y"))
    assert len(re.findall(r"<use [^>]*var\(--series-1\)", svg)) == num_dots


def test_interval_of_a_single_point_is_a_bar():
    plain, with_bar = (plot_lines([Line("", [1], [5.0], *ends)], Labels("", "x", "y")) for ends in ([], [[4.0], [6.0]]))
    paths = [re.findall(r'<path d="(M[^"]*)"[^>]*stroke: var\(--series-1\)', svg) for svg in (plain, with_bar)]
    assert not any("L" in path for path in paths[0]) and any("L" in path for path in paths[1])


def test_page_escapes_text_and_a_film_that_is_too_large_is_named(tmp_path):
    path = tmp_path / "film.webm"
    path.write_bytes(b"0" * 100)
    parts = [table([["<b>"], ["1"]]), film(path, "f", largest=10), film(tmp_path / "none.webm", "f")]
    page = render_page("<title>", [Section("<s>", "<i>", parts), Section("empty", "", [])])
    assert "<b>" not in page and "<i>" not in page and "empty" not in page
    assert "too large" in page and "There is no film" in page
    assert scrubber("iteration", [("1 of 1", "x")]).count("data-name") == 2


def test_tile_keeps_pictures_apart():
    black = np.zeros((2, 4, 4, 3), np.uint8)
    assert tile([black, black]).shape == (9, 9, 3) and (tile([black, black])[4] == 128).all()


def record_clauses(clauses):
    """The recording of decisions before which the goals had these clauses."""
    goals = SimpleNamespace(objective_scores=[], clauses=[])
    recorder = EpisodeRecorder(SimpleNamespace(), len(clauses), goals=goals)
    for decision, goals.clauses in enumerate(clauses):
        recorder(Step(0, decision, 0.0, np.zeros((4, 4, 3), np.uint8), np.zeros(1, np.float32)))
    return recorder.recording


def test_shares_of_clauses_count_only_decisions_at_which_the_clause_was_part_of_the_goals():
    one, other = ("cart < 1", True), ("upright > 0", True)
    recording = record_clauses([[], [one], [one], [other], [other], [one, one]])
    assert recording.clauses == {
        "cart < 1": [None, True, True, None, None, True],
        "upright > 0": [None, None, None, True, True, None],
    }
    rows = re.findall("<td>(.*?)</td><td.*?>(.*?)</td>", "".join(_goals(recording)))
    assert rows == [("cart &lt; 1", "100.0 %"), ("upright &gt; 0", "100.0 %")]


def test_clause_in_objective_and_constraint_is_met_where_both_say_so():
    recording = record_clauses([[], [("a", True), ("a", False)], [("a", True), ("a", True)], [("a", False)]])
    assert recording.clauses == {"a": [None, False, True, False]}


def test_recorder_of_an_agent_without_a_model_keeps_actions_and_returns():
    agent = SimpleNamespace(act=lambda frame: np.zeros(2, np.float32), reset=lambda: None, seed=lambda seed: None)
    recorder = EpisodeRecorder(agent, None)
    run_episodes(NoisyEnv(), agent, [0], on_step=recorder)
    assert len(recorder.recording.actions) == DECISIONS and not recorder.recording.surprise
    assert torch.is_grad_enabled()
