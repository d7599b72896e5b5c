"""Films of episodes, written by a callback that gets every step of an episode."""

from __future__ import annotations

import contextlib
import os
import warnings
from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING, Any, Protocol

from latentplan.reporting.frame import PANEL_SIZE, Frame, compose_frame, draw_goal_strip
from latentplan.reporting.video import VideoWriter

if TYPE_CHECKING:
    import gymnasium

DEFAULT_FPS = 20.0


class Moment(Protocol):
    """One step of an episode; `latentplan.evaluation.episodes.Step` is one."""

    @property
    def episode(self) -> int:
        """Index of the episode."""

    @property
    def decision(self) -> int:
        """Number of decisions executed before this step."""

    @property
    def total_return(self) -> float:
        """Sum of the rewards before this step."""

    @property
    def frame(self) -> Frame:
        """Observation of the agent, uint8 (height, width, 3)."""

    @property
    def action(self) -> Any:
        """Action of the agent, or None at the end of the episode."""


class ImaginingAgent(Protocol):
    """An agent that can decode the last state of its plan.

    Attributes:
        steps_ahead: Model steps from the present to the last imagined frame.
    """

    steps_ahead: int

    def imagine(self) -> Frame | None:
        """The decoded last state of the plan, uint8 (height, width, 3); None without a plan."""
        ...


class GoalScores(Protocol):
    """Scores of the objective and the constraints of the episode that is filmed."""

    @property
    def objective_scores(self) -> Sequence[float]:
        """Score of the objective at each env frame so far; empty without an objective."""

    @property
    def clauses(self) -> Sequence[tuple[str, bool]]:
        """Text of every clause, and whether the clause is met; empty before the first env frame."""


@contextlib.contextmanager
def filming(
    path: str | os.PathLike[str],
    env: gymnasium.Env[Any, Any],
    planner: ImaginingAgent | None,
    *,
    every: int = 1,
    goals: GoalScores | None = None,
) -> Iterator[Callable[[Moment], None]]:
    """Films the first episode inside the `with` block, in real time if the environment tells its frame rate.

    An episode that is played again, after a fault of the environment, is filmed anew.

    Args:
        path: Path of the film, `.mp4` or `.webm`; the file is created when the block ends without an error.
        env: The environment of the episode; its method `render_large`, where it exists, renders the pictures.
        planner: The agent, if it plans; None leaves the right side empty.
        every: Decisions per frame of the film; the end of the episode always gets a frame. The film keeps the duration
            of the episode.
        goals: Scores of an objective or constraints; the film shows the scores in a strip.

    Yields:
        The callback, to be called with every step.
    """
    with contextlib.ExitStack() as stack:
        films: list[VideoWriter] = []

        def film(moment: Moment) -> None:
            if moment.episode > 0 or (moment.decision % every and moment.action is not None):
                return
            if moment.decision == 0 and films:  # the episode is played again, after a fault
                stack.pop_all()  # the writer is not to finish its film
                films.pop().discard()
            picture = _compose(moment, env, planner, goals)
            if not films:
                fps = float(env.unwrapped.metadata.get("render_fps") or DEFAULT_FPS)
                films.append(stack.enter_context(VideoWriter(path, fps / every, (picture.shape[1], picture.shape[0]))))
            films[0].write(picture)

        yield film


@contextlib.contextmanager
def filming_if_possible(
    path: str | os.PathLike[str], env: gymnasium.Env[Any, Any], planner: ImaginingAgent | None, *, every: int = 1
) -> Iterator[Callable[[Moment], None]]:
    """The same as `filming`, but an error of the film becomes a warning and the episode goes on without a film."""
    errors: list[Exception] = []
    with contextlib.ExitStack() as stack:
        film = stack.enter_context(filming(path, env, planner, every=every))

        def try_to_film(moment: Moment) -> None:
            if not errors:
                try:
                    film(moment)
                except Exception as error:
                    errors.append(error)

        yield try_to_film
        try:
            if errors:
                stack.pop_all().__exit__(type(errors[0]), errors[0], errors[0].__traceback__)
            else:
                stack.close()
        except Exception as error:
            errors.append(error)
    if errors:
        warnings.warn(f"no film at {path}: {errors[0]}", RuntimeWarning, stacklevel=1)


def _compose(
    moment: Moment, env: gymnasium.Env[Any, Any], planner: ImaginingAgent | None, goals: GoalScores | None
) -> Frame:
    is_over = moment.action is None
    render = getattr(env.unwrapped, "render_large", None)
    imagined = None if planner is None or is_over else planner.imagine()
    return compose_frame(
        moment.frame if render is None else render(PANEL_SIZE),
        imagined,
        [f"return {moment.total_return:.1f}    step {moment.decision}"],
        horizon=None if planner is None else planner.steps_ahead,
        absence="episode over" if is_over else "no plan",
        strip=None if goals is None else draw_goal_strip(goals.objective_scores, goals.clauses),
    )
