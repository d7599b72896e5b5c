"""Records what an agent knew, searched and imagined in one episode, for the report of the episode.

The recorder is a callback for every step of an episode. It never changes an action: it reads the agent after each
decision, asks the search to keep its candidates at a few chosen decisions, and lets the model imagine when the episode
has ended.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from latentplan.reporting.film import Moment
from latentplan.reporting.frame import Frame

Floats = NDArray[np.float32]
NUM_MOMENTS = 4
NUM_CANDIDATES = 48  # of a search that are drawn and decoded
NUM_PICTURES = 6  # of an imagined rollout
NUM_STARTS = 16  # of rollouts that are compared with the real episode
NUM_STRIPS = 3
COMPARED_STEPS = 30
UNKNOWN_LENGTH = 250  # decisions of an episode without a known end


class SearchStep(NamedTuple):
    """One iteration of a search.

    Attributes:
        candidates: Some candidates that are no elites, (sample, horizon, action).
        elites: Some elites, best first, (elite, horizon, action).
        mean: Mean of the search distribution after the iteration, (horizon, action).
        elite_return: Mean predicted return of all elites.
        candidate_pictures: Mean picture over candidates and elites at the shown steps, uint8 (step, side, side, 3).
        elite_pictures: Mean picture over the elites, uint8 (step, side, side, 3); black without elites.
    """

    candidates: Floats
    elites: Floats
    mean: Floats
    elite_return: float
    candidate_pictures: Frame
    elite_pictures: Frame


class Inspection(NamedTuple):
    """A decision that was looked at closely.

    Attributes:
        decision: Number of the decision.
        frame: The frame of the decision, uint8 (height, width, 3).
        shown_steps: Model steps of the pictures, from 1.
        search: Iterations of the search, in order.
        plan_pictures: Imagined along the plan, uint8 (step, side, side, 3).
        actor_pictures: Imagined along the actor, uint8 (step, side, side, 3).
        plan_reward: Predicted sum of rewards along the plan.
        actor_reward: The same along the actor.
    """

    decision: int
    frame: Frame
    shown_steps: Sequence[int]
    search: Sequence[SearchStep]
    plan_pictures: Frame
    actor_pictures: Frame
    plan_reward: float
    actor_reward: float


class Strip(NamedTuple):
    """A part of the episode beside its imagination from the first belief and the executed actions.

    Attributes:
        decision: Number of the first decision.
        steps: Model steps of the pictures, from 1.
        real: Frames, uint8 (step, side, side, 3).
        imagined: Decoded states, uint8 (step, side, side, 3).
    """

    decision: int
    steps: Sequence[int]
    real: Frame
    imagined: Frame


@dataclass
class Recording:
    """What was recorded in one episode; lists have one entry per decision.

    Attributes:
        actions: Actions of the agent, each (action,).
        actor_actions: What the actor would have done, each (action,); empty for an agent without an actor.
        sources: Origin of each action: "plan", "tail" or "actor".
        surprise: Surprise of each frame, in nats; empty for an agent without a world model.
        threshold: Threshold of the gate after each decision, in standard deviations; empty without a gate.
        totals: Return before each decision, and at last the return of the episode.
        clauses: Whether each clause of the goals was met before each decision, by its text; None at the first decision
            and while a clause is not part of the goals, as before the phase of its objective begins.
        inspections: The decisions that were looked at closely.
        strips: Parts of the episode beside their imagination.
        picture_error: Mean absolute difference of imagined and real pictures, in grey levels, (start, step).
        reward_error: Absolute difference of predicted and real rewards, (start, step).
        objective_scores: Score of the objective at each env frame; empty without an objective.
        surprise_limit: Surprise above which the actor acted, in nats; None where no decision had such a limit.
    """

    actions: list[Floats] = field(default_factory=list)
    actor_actions: list[Floats] = field(default_factory=list)
    sources: list[str] = field(default_factory=list)
    surprise: list[float] = field(default_factory=list)
    threshold: list[float] = field(default_factory=list)
    totals: list[float] = field(default_factory=list)
    clauses: dict[str, list[bool | None]] = field(default_factory=dict)
    inspections: list[Inspection] = field(default_factory=list)
    strips: list[Strip] = field(default_factory=list)
    picture_error: Floats = field(default_factory=lambda: np.zeros((0, 0), np.float32))
    reward_error: Floats = field(default_factory=lambda: np.zeros((0, 0), np.float32))
    objective_scores: list[float] = field(default_factory=list)
    surprise_limit: float | None = None


class EpisodeRecorder:
    """Records the first episode of an agent; call it with every step, as `on_step` of `evaluate_agent`.

    Args:
        agent: The agent; of one without a world model only actions and rewards are recorded.
        num_decisions: Decisions of an episode, if known.
        goals: Scores of an objective or constraints; None without.
        waits: Whether the world waits for the agent; otherwise imagination is not compared with the episode, because
            actions take effect with a delay.

    Attributes:
        recording: What was recorded so far.
    """

    def __init__(self, agent: Any, num_decisions: int | None, *, goals: Any | None = None, waits: bool = True) -> None:
        self.agent, self.goals, self.waits = agent, goals, waits
        self._has_model = hasattr(agent, "imagine_along")
        self._length = num_decisions or UNKNOWN_LENGTH
        controller = getattr(agent, "controller", None)
        self._controller = controller if hasattr(controller, "keep") else None
        self._begin()

    def _begin(self) -> None:
        """Forget everything; the first search of an episode is always looked at."""
        share = np.arange(NUM_MOMENTS) / NUM_MOMENTS
        self.recording = Recording()
        self._wanted = sorted({int(each * self._length) for each in share})
        self._frames: list[Frame] = []
        self._beliefs: list[Any] = []
        self._choose_next(0)

    def __call__(self, moment: Moment) -> None:
        """Records one step."""
        if moment.episode > 0:
            return
        if moment.decision == 0 and self.recording.totals:  # the episode is played again, after a fault
            self._begin()
        self.recording.totals.append(moment.total_return)
        self._frames.append(np.array(moment.frame))
        if moment.action is None:
            self._finish()
            return
        recording, agent = self.recording, self.agent
        recording.actions.append(np.array(moment.action, np.float32))
        recording.sources.append(getattr(agent, "last_source", "actor"))
        if self.goals is not None:
            self._note_clauses(self.goals.clauses)
        if not self._has_model:
            return
        recording.actor_actions.append(agent.actor_action())
        recording.surprise.append(agent.surprise())
        limit = getattr(agent, "effective_surprise_limit", None)
        recording.surprise_limit = recording.surprise_limit if limit is None else limit
        if hasattr(agent, "threshold"):
            recording.threshold.append(float(agent.threshold))
        self._beliefs.append(agent.belief())
        self._look_at_search(moment)
        self._choose_next(moment.decision + 1)

    def _note_clauses(self, clauses: Sequence[tuple[str, bool]]) -> None:
        """Notes one value per clause; a clause that stands in objective and constraint is met if both say so."""
        noted, known = self.recording.clauses, dict[str, bool]()
        for text, is_met in clauses:
            known[text] = known.get(text, True) and is_met
            noted.setdefault(text, [None] * (len(self.recording.actions) - 1))
        for text, met in noted.items():
            met.append(known.get(text))

    def _choose_next(self, decision: int) -> None:
        """Let the search of the next decision keep its candidates, if that decision is wanted."""
        if self._controller is not None:
            self._controller.keep = "candidates" if self._wanted and self._wanted[0] <= decision else None

    def _look_at_search(self, moment: Moment) -> None:
        if self._controller is None or self._controller.keep is None or self._controller.plan is None:
            return
        plan = self._controller.plan
        if not plan.candidates or self.recording.sources[-1] != "plan":
            return  # the next planned decision takes its place
        self._wanted.pop(0)
        actions = plan.actions[:1].float().cpu().numpy()
        horizon = actions.shape[1]
        shown = spread(horizon, NUM_PICTURES)
        by_plan = self.agent.imagine_along([self._beliefs[-1]], actions, horizon, shown)
        by_actor = self.agent.imagine_along([self._beliefs[-1]], None, horizon, shown)
        search = [self._read_iteration(each, shown) for each in plan.candidates]
        self.recording.inspections.append(
            Inspection(
                moment.decision,
                self._frames[-1],
                [step + 1 for step in shown],
                search,
                by_plan.pictures[0],
                by_actor.pictures[0],
                float(by_plan.rewards.sum()),
                float(by_actor.rewards.sum()),
            )
        )

    def _read_iteration(self, iteration: Any, shown: Sequence[int]) -> SearchStep:
        others, elites = choose_candidates(iteration)
        rows = np.concatenate([elites, others])
        pictures = self.agent.imagine_along([self._beliefs[-1]], rows, rows.shape[1], shown).pictures
        return SearchStep(
            others,
            elites,
            iteration.mean[0].float().cpu().numpy(),
            float(iteration.elite_return[0]),
            _mean_picture(pictures),
            _mean_picture(pictures[: len(elites)]),
        )

    def stop(self) -> None:
        """Let searches keep nothing any more."""
        if self._controller is not None:
            self._controller.keep = None

    def _finish(self) -> None:
        self.stop()
        if self.goals is not None:
            self.recording.objective_scores = list(self.goals.objective_scores)
        steps = min(COMPARED_STEPS, len(self._beliefs))
        if not self._has_model or not self.waits or steps < 1:
            return
        starts = spread(len(self._beliefs) - steps + 1, NUM_STARTS)
        actions = np.stack([self.recording.actions[start : start + steps] for start in starts])
        imagined = self.agent.imagine_along([self._beliefs[start] for start in starts], actions, steps)
        real = np.stack([[_shrink(self._frames[start + step + 1]) for step in range(steps)] for start in starts])
        gains = np.diff(self.recording.totals)
        rewards = np.stack([gains[start : start + steps] for start in starts])
        difference = np.abs(imagined.pictures.astype(np.float32) - real)
        self.recording.picture_error = difference.mean(axis=(2, 3, 4))
        self.recording.reward_error = np.abs(imagined.rewards - rewards).astype(np.float32)
        shown = spread(steps, NUM_PICTURES)
        for row in spread(len(starts), NUM_STRIPS):
            steps_shown = [step + 1 for step in shown]
            self.recording.strips.append(
                Strip(int(starts[row]), steps_shown, real[row][shown], imagined.pictures[row][shown])
            )


def choose_candidates(iteration: Any) -> tuple[Floats, Floats]:
    """Some candidates of an iteration of the first environment's search, to be drawn.

    Args:
        iteration: The iteration; see `latentplan.planning.plan.Iteration`.

    Returns:
        Candidates that are no elites, (sample, horizon, action), and elites, best first, (elite, horizon, action).
    """
    elites = iteration.elites[0].float().cpu().numpy()
    elites = elites[np.isfinite(elites).all(axis=(1, 2))]
    known = {elite.tobytes() for elite in elites}
    others = [row for row in iteration.actions[0].float().cpu().numpy() if row.tobytes() not in known]
    drawn = elites[spread(len(elites), NUM_CANDIDATES // 2)]
    rest = np.array(others, np.float32).reshape(-1, *elites.shape[1:])
    return rest[spread(len(rest), NUM_CANDIDATES - len(drawn))], drawn


def spread(length: int, num: int) -> list[int]:
    """At most `num` whole numbers from 0 to `length - 1`, evenly spaced, with both ends."""
    if length <= 0 or num <= 0:
        return []
    return sorted({int(round(place)) for place in np.linspace(0, length - 1, min(num, length))})


def _mean_picture(pictures: Frame) -> Frame:
    """The mean over rows of pictures (row, step, height, width, 3); black without rows."""
    if len(pictures) == 0:
        return np.zeros(pictures.shape[1:], np.uint8)
    return pictures.astype(np.float32).mean(axis=0).round().astype(np.uint8)


def _shrink(frame: Frame) -> Frame:
    """The first camera of a frame (height, width, 3 * camera) at half the size, as decoded pictures have."""
    pairs = frame[..., :3].astype(np.float32).reshape(frame.shape[0] // 2, 2, frame.shape[1] // 2, 2, 3)
    return pairs.mean(axis=(1, 3)).round().astype(np.uint8)


class GuardedRecorder:
    """A recorder whose errors become a warning, so that the episode goes on without a recording.

    Args:
        recorder: The recorder.
    """

    def __init__(self, recorder: EpisodeRecorder) -> None:
        self._recorder: EpisodeRecorder | None = recorder

    def __call__(self, moment: Moment) -> None:
        """Records one step."""
        if self._recorder is None:
            return
        try:
            self._recorder(moment)
        except Exception as error:
            self._recorder.stop()
            self._recorder = None
            warnings.warn(f"nothing of this episode is in the report: {error}", RuntimeWarning, stacklevel=2)

    @property
    def recording(self) -> Recording | None:
        """What was recorded so far; None after an error."""
        return None if self._recorder is None else self._recorder.recording
