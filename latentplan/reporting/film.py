"""The film of an episode, as a callback for rollouts."""

from __future__ import annotations

import contextlib
import os
import warnings
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any, Protocol

from latentplan.reporting.goal import Judge, draw_goal
from latentplan.reporting.video import GAP, PANEL_SIZE, Frame, VideoWriter, compose_frame

if TYPE_CHECKING:
    import gymnasium

DEFAULT_FPS = 20.0


class Moment(Protocol):
    """What a film needs to know of one moment of an episode; rollouts hand it to their callback."""

    @property
    def episode(self) -> int:
        """Index of the episode."""

    @property
    def decision(self) -> int:
        """Decisions executed before this moment."""

    @property
    def total_return(self) -> float:
        """Reward earned before this moment."""

    @property
    def frame(self) -> Frame:
        """What the agent sees, uint8 (height, width, 3)."""

    @property
    def action(self) -> Any:
        """What it chose, or None where the episode is over."""


class Imagining(Protocol):
    """An agent that can show where its present plan ends.

    Attributes:
        steps_ahead: Model steps from now to what it showed last.
    """

    steps_ahead: int

    def imagine(self) -> Frame | None:
        """The decoded last state of the plan, uint8 (height, width, 3); None without a plan."""
        ...


@contextlib.contextmanager
def filming(
    path: str | os.PathLike[str],
    env: gymnasium.Env[Any, Any],
    planner: Imagining | None,
    *,
    every: int = 1,
    judge: Judge | None = None,
) -> Iterator[Callable[[Moment], None]]:
    """Films the first episode that is played inside the block, in real time where the environment tells its rate.

    Args:
        path: Where the film goes, `.mp4` or `.webm`; it appears when the block ends well.
        env: The environment that is played; `render_large` gives the picture where it has that.
        planner: The agent, where it plans; None leaves the plan's side empty.
        every: Decisions per picture (the last moment has one whatever that is); the film keeps the time of the episode.
        judge: Who scores an objective or constraints; the film then shows how they are met.

    Yields:
        The callback to hand to the rollouts.
    """
    with contextlib.ExitStack() as stack:
        films: list[VideoWriter] = []

        def film(moment: Moment) -> None:
            if moment.episode > 0 or (moment.decision % every and moment.action is not None):
                return
            picture = _compose(moment, env, planner, judge)
            if not films:
                fps = float(env.unwrapped.metadata.get("render_fps") or DEFAULT_FPS)
                films.append(stack.enter_context(VideoWriter(path, fps / every, (picture.shape[1], picture.shape[0]))))
            films[0].write(picture)

        yield film


@contextlib.contextmanager
def filming_if_possible(
    path: str | os.PathLike[str], env: gymnasium.Env[Any, Any], planner: Imagining | None, *, every: int = 1
) -> Iterator[Callable[[Moment], None]]:
    """As `filming`, but where a film fails there is a warning and no film, and the episode goes on without it."""
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


def _compose(moment: Moment, env: gymnasium.Env[Any, Any], planner: Imagining | None, judge: Judge | None) -> Frame:
    over = moment.action is None
    render = getattr(env.unwrapped, "render_large", None)
    imagined = None if planner is None or over else planner.imagine()
    return compose_frame(
        moment.frame if render is None else render(PANEL_SIZE),
        imagined,
        [f"return {moment.total_return:.1f}    step {moment.decision}"],
        horizon=None if planner is None else planner.steps_ahead,
        absence="episode over" if over else "no plan",
        strip=None if judge is None else draw_goal(2 * PANEL_SIZE + GAP, judge.worth, judge.clauses),
    )
