"""The command line of `scripts/eval.py`: flags in, a checked request out; nothing slow is imported."""

from __future__ import annotations

import math
from argparse import SUPPRESS
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from latentplan.commands.main import read_flags
from latentplan.config import DEVICES, PlannerConfig, UserError, output_file
from latentplan.config.files import field_names, raise_unknown

if TYPE_CHECKING:
    from latentplan.evaluation.latency import Latency

MOST_DIGITS = 18
PLANNING_MODES = ("planner", "gated", "background")  # who pursues an objective; the others are scored on it
MODES = (*PLANNING_MODES, "actor", "random")
FLAGS = {
    "--checkpoint": ("DIR", "folder of a trained agent, or of a run (its best checkpoint)"),
    "--episodes": ("N", "episodes to play (10)"),
    "--objective": (
        "TEXT",
        "what counts instead of the task, such as 'speed -> 2.0 and height > 1.1' (docs/zero-shot.md)",
    ),
    "--constraint": ("TEXT", "what must hold at every moment, such as 'cart < 0.5'; may be repeated"),
    "--mode": ("|".join(MODES), "who acts (planner)"),
    "--planning-budget": ("B", "share of its decisions that a gated agent may plan, 0 to 1 (0.3)"),
    "--video": ("FILE", "film of the first episode, .mp4 or .webm"),
    "--json": ("FILE", "result as JSON"),
    "--control-hz": ("F", "decisions per second of a world that goes on while the agent thinks (it waits)"),
    "--latency": ("measured|FILE", "what thinking costs there: as measured, or drawn from a file of ms (measured)"),
    "--seed": ("S", "episode i starts from a state that depends only on S and i (0)"),
    "--device": ("|".join(DEVICES), "where the agent computes (auto: cuda where usable)"),
    "--threads": ("N", "CPU threads (torch's own choice; 1 for actor and background)"),
}


@dataclass(frozen=True)
class EvaluationRequest:
    """What the command line asks for.

    Attributes:
        checkpoint: Folder of the agent.
        episodes: Episodes to play.
        objective: What counts instead of the task, or None.
        constraint: What must hold at every moment, or None.
        mode: One of `MODES`.
        planner: Planner settings that replace the agent's, as they were typed.
        planning_budget: Share of its decisions that a gated agent may plan, or None for its own choice.
        video: Where the film goes, or None.
        json: Where the result goes, or None.
        control_hz: Decisions per second of a world that does not wait, or None for one that does.
        latency: What thinking costs there.
        seed: Seed of the starts.
        device: `auto`, `cpu` or `cuda`.
        threads: CPU threads, or None to leave it to torch.
    """

    checkpoint: Path
    episodes: int
    objective: str | None
    constraint: str | None
    mode: str
    planner: dict[str, str]
    planning_budget: float | None
    video: Path | None
    json: Path | None
    control_hz: float | None
    latency: Latency
    seed: int
    device: str
    threads: int | None


def parse_arguments(argv: Sequence[str]) -> EvaluationRequest:
    """Read the command line.

    Raises:
        UserError: A flag or value is wrong, or an output path cannot be written; the message says what to give.
    """
    settings = [f"--planner.{name}" for name in field_names("planner")]
    flags = read_flags(argv, [*FLAGS, *settings], {"--constraint": "; "})
    if "--checkpoint" not in flags:
        raise UserError("flag --checkpoint is missing; give the folder of a trained agent or of a run")
    mode, device = flags.get("--mode", "planner"), flags.get("--device", "auto")
    if mode not in MODES:
        raise_unknown("mode", mode, MODES)
    if device not in DEVICES:
        raise_unknown("device", device, DEVICES)
    planner = {name.removeprefix("--planner."): value for name, value in flags.items() if name in settings}
    if planner and mode not in PLANNING_MODES:
        raise UserError(f"--planner.{next(iter(planner))} has no effect in mode {mode}; use --mode planner")
    if "--planning-budget" in flags and mode != "gated":
        raise UserError(f"--planning-budget has no effect in mode {mode}; use --mode gated")
    from latentplan.evaluation.latency import read_clock_flags

    control_hz, latency = read_clock_flags(flags)
    video, result = _output_paths(flags)
    return EvaluationRequest(
        checkpoint=Path(flags["--checkpoint"]),
        episodes=_whole_number(flags, "--episodes", 10, 1),
        objective=flags.get("--objective"),
        constraint=flags.get("--constraint"),
        mode=mode,
        planner=planner,
        planning_budget=_share(flags, "--planning-budget") if "--planning-budget" in flags else None,
        video=video,
        json=result,
        control_hz=control_hz,
        latency=latency,
        seed=_whole_number(flags, "--seed", 0, 0),
        device=device,
        threads=_whole_number(flags, "--threads", 1, 1) if "--threads" in flags else None,
    )


def help_text() -> str:
    """What `--help` prints."""
    from jsonargparse import ArgumentParser

    parser = ArgumentParser(prog="eval.py", usage="%(prog)s --checkpoint DIR [--name value ...]")
    parser.description = "Play a trained agent in closed loop: return, decision latency, film."
    parser.epilog = (
        "Planner defaults shown are the program's; a checkpoint brings its own, which hold unless given here."
    )
    for flag, (metavar, meaning) in FLAGS.items():
        parser.add_argument(flag, metavar=metavar, default=SUPPRESS, help=meaning)
    parser.add_argument("--planner", type=PlannerConfig)
    parser._option_string_actions["--planner"].help = SUPPRESS
    return parser.format_help()


def _whole_number(flags: dict[str, str], name: str, default: int, least: int) -> int:
    text = flags.get(name, str(default))
    if not text.isascii() or not text.isdigit() or len(text) > MOST_DIGITS or int(text) < least:
        raise UserError(f"{name} must be a whole number of at least {least}, got {text!r}")
    return int(text)


def _share(flags: dict[str, str], name: str) -> float:
    try:
        value = float(flags[name])
    except ValueError:
        value = math.nan
    if not 0.0 <= value <= 1.0:
        raise UserError(f"{name} must be a number from 0 to 1, got {flags[name]!r}")
    return value


def _output_paths(flags: dict[str, str]) -> tuple[Path | None, Path | None]:
    """Where film and result go."""
    video, result = _output_path(flags, "--video"), _output_path(flags, "--json")
    if video is not None and result is not None and video.resolve() == result.resolve():
        raise UserError("--video and --json name the same file; give two")
    return video, result


def _output_path(flags: dict[str, str], name: str) -> Path | None:
    """The path of an output, tried before any work is spent on what goes there."""
    if name not in flags:
        return None
    path = Path(flags[name])
    if name == "--video":
        from latentplan.reporting.video import check_video_path

        check_video_path(path)
    return output_file(path, name)
