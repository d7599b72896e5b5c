"""`latentplan card`: write the card of an agent, a README.md in the format of the model hub."""

from __future__ import annotations

import hashlib
import re
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from latentplan import __version__
from latentplan.commands.flags import overrides
from latentplan.commands.shell import ComputeRequest, saved_config
from latentplan.config import EnvConfig, UserError, output_file
from latentplan.config.checks import MAX_EPISODES, at_least, shown, within
from latentplan.config.env_id import ENV_FLAGS, EnvChoice, choose_env
from latentplan.config.parsing import option
from latentplan.config.reading import LARGEST_SETTINGS, read_text

if TYPE_CHECKING:
    from latentplan.reporting.card import CardReturn

FILM_FRAMES = 250
MODES = ("planner", "actor")


@dataclass(frozen=True, kw_only=True)
class Request(ComputeRequest):
    """The command line of a card.

    Attributes:
        checkpoint: Folder of a trained agent, or of a run (its best checkpoint).
        episodes: Episodes of planner and actor to play for the card, the first of which is filmed; None takes the
            returns that the agent remembers.
        seed: Seed of the starts: episode i starts from a state that depends only on the seed and i.
        licence: Licence of the agent, by its identifier on the model hub, such as `mit` or `apache-2.0`.
        force: Whether a README.md that this command did not write, or that was edited since, is replaced.
        env: The environment, where the agent does not remember it; the card names it.
    """

    NOTES = "The card, README.md, and the film, replay.mp4, are written into the folder of the agent."

    checkpoint: Path = option(metavar="DIR")
    episodes: int | None = None
    seed: int = 0
    licence: str = "mit"
    force: bool = False
    env: dict[str, Any] = overrides(EnvChoice, ENV_FLAGS, prefix="env.")

    def __post_init__(self) -> None:
        super().__post_init__()
        at_least(self, seed=0)
        if self.episodes is not None:
            within(self, episodes=(1, MAX_EPISODES))
        elif self.seed:
            raise UserError("--seed has no effect without --episodes: no episode is played")
        if not re.fullmatch(r"[a-z0-9][a-z0-9.-]{0,60}", self.licence):
            raise UserError(f"--licence must be an identifier such as mit or apache-2.0, got {shown(self.licence)}")


def run(request: Request) -> int:
    """Write the card, print where it is, and return the exit code.

    Raises:
        UserError: The agent cannot be used, or a README.md of another origin is in its folder.
    """
    from latentplan.agents.files import CARD, FILM, INFO
    from latentplan.agents.info import read_info, read_spaces, resolve_checkpoint

    folder = resolve_checkpoint(request.checkpoint)
    before, info = _checksum(folder), read_info(folder)
    config = saved_config(folder, info)
    chosen = choose_env(config.env, request.env, must_match=True)
    path = output_file(folder / CARD, "--checkpoint")
    film = None if request.episodes is None else output_file(folder / FILM, "--checkpoint")
    earlier = "" if request.force else _read_own(path, folder / FILM, film is not None)
    try:
        spaces = read_spaces(info)
    except (TypeError, ValueError) as error:
        raise UserError(f"{folder / INFO} cannot be used: {error}") from None
    from latentplan.evaluation.statistics import confidence_interval
    from latentplan.reporting.card import CardData, recorded_returns, render_card, seal_card

    returns = recorded_returns(info, config, confidence_interval)
    with tempfile.TemporaryDirectory(prefix=".card.", dir=folder) as made:
        if film is not None:
            returns = _measure(request, folder, info, chosen, Path(made) / FILM) + returns
        text = render_card(CardData(info, config, spaces, returns, None if film is None else FILM, request.licence))
        (Path(made) / CARD).write_text(seal_card(text, before), encoding="utf-8")
        if _checksum(folder) != before:
            raise UserError(f"the agent in {folder} was replaced while its card was made: call the command again")
        if film is not None:
            (Path(made) / FILM).replace(film)
        elif _names_film(earlier):
            (folder / FILM).unlink(missing_ok=True)  # the card that it belongs to is replaced
        (Path(made) / CARD).replace(path)
    print(f"card: {path}" + (f", film: {film}" if film else ""))
    if not returns:
        print("the agent remembers no returns of its weights; --episodes 10 measures them for the card")
    return 0


def _checksum(folder: Path) -> str:
    """The checksum of the description of an agent, which holds that of its weights."""
    from latentplan.agents.files import INFO, read_files

    return hashlib.sha256(read_files(folder, (INFO,))[INFO]).hexdigest()


def _read_own(path: Path, film: Path, replaces_film: bool) -> str:
    """The card that this command wrote before, empty without one; refuses what a person may want to keep.

    Args:
        path: Path of the card.
        film: Path of the film.
        replaces_film: Whether a film will be written.

    Raises:
        UserError: The card or the film exists, and this command did not write it as it is.
    """
    from latentplan.reporting.card import read_seal

    remedy = "--force true replaces it"
    text = ""
    if path.exists():
        text = read_text(path, LARGEST_SETTINGS)
        seal = read_seal(text)
        if seal is None:
            raise UserError(f"{path} was not written by this command; {remedy}")
        if not seal.is_intact:
            raise UserError(f"{path} was edited since this command wrote it; {remedy}")
    if replaces_film and film.exists() and not _names_film(text):
        raise UserError(f"{film} was not written by this command; {remedy}")
    return text


def _names_film(card: str) -> bool:
    from latentplan.agents.files import FILM

    return f"]({FILM})" in card


def _measure(request: Request, folder: Path, info: dict[str, Any], chosen: EnvConfig, film: Path) -> list[CardReturn]:
    """Plays planner and actor from the same starts, and films the planner's first episode."""
    import contextlib

    from latentplan.agents.checkpoint import load_agent
    from latentplan.commands.evaluate import open_env
    from latentplan.evaluation.episodes import evaluate_agent
    from latentplan.evaluation.statistics import confidence_interval
    from latentplan.reporting.card import summarize_returns
    from latentplan.reporting.film import filming

    assert request.episodes is not None
    device, found = request.use_device(), []
    given = "".join(f", env.{name} {value}" for name, value in request.env.items())
    origin = f"for this card, seed {request.seed}, latentplan {__version__}{given}"
    env = open_env(chosen, info)
    try:
        length = getattr(env.unwrapped, "decisions_per_episode", None) or 0
        for mode in MODES:
            agent: Any = load_agent(folder, mode, device)
            with contextlib.ExitStack() as stack:
                write = None
                if mode == "planner":
                    write = stack.enter_context(filming(film, env, agent, every=-(-length // FILM_FRAMES) or 1))
                result = evaluate_agent(agent, env, request.seed, request.episodes, on_step=write)
            entry = summarize_returns(mode, result["returns"], confidence_interval, origin, is_measured=True)
            print(f"{mode}: mean return {entry.mean:.1f} of {entry.num_episodes} episodes", flush=True)
            found.append(entry)
    finally:
        env.close()
    return found
