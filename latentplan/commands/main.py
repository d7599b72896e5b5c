"""The command line: flags become a run; every user's mistake becomes one line on stderr and exit code 2.

Parsing imports neither torch nor lightning nor a simulator, so that `--help` and bad flags answer at once.
"""

from __future__ import annotations

import errno
import os
import sys
from argparse import SUPPRESS
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from latentplan import __version__
from latentplan.config import MAX_THREADS, Config, UserError
from latentplan.config.files import (
    PRESETS,
    SECTIONS,
    Layer,
    build_config,
    compose,
    field_names,
    raise_unknown,
    read_config,
    read_layer,
    settings_parser,
)

COMMANDS = ("train", "eval", "distill", "goals", "export", "doctor")
RESUMABLE = ("--frames", "--minutes", "--device")
SHORT_FLAGS = {
    "--domain": ("env.domain", "domain of dm_control.suite (short for --env.domain)"),
    "--task": ("env.task", "task of the domain; the domain's usual one unless given (--env.task)"),
    "--frames": ("run.frames", "simulator frames to train for (--run.frames)"),
    "--minutes": ("run.minutes", "minutes to train for; given with --frames, whichever ends first (--run.minutes)"),
    "--device": ("run.device", "auto, cpu or cuda (--run.device)"),
    "--seed": ("run.seed", "seed of every random stream (--run.seed)"),
    "--run-dir": ("run.run_dir", "folder of the run (--run.run_dir)"),
}
OTHER_FLAGS = {
    "--preset": "machine class: auto, cpu or gpu; auto takes gpu where CUDA is usable",
    "--config": "YAML file of settings, laid over the preset",
    "--resume": f"continue the run in this folder; only {', '.join(RESUMABLE)} may be given besides",
}
EXPORT_FLAGS = {
    "--checkpoint": ("DIR", "folder of a trained agent, or of a run (its best checkpoint)"),
    "--out": ("FILE", "the file to write"),
    "--format": ("pt2|onnx", "program of torch.export, or ONNX where onnx and onnxscript are installed (pt2)"),
}
METAVARS = {"--frames": "N", "--minutes": "M", "--run-dir": "DIR", "--resume": "DIR", "--config": "FILE"}


class TrainCommand(NamedTuple):
    """What the command line of a training run asks for.

    Attributes:
        config: Settings of the run; the saved ones when it resumes.
        resume_dir: Folder of the run to continue, or None to start a new one.
        changes: Fields of `RunConfig` that replace the saved ones when a run resumes.
    """

    config: Config
    resume_dir: Path | None
    changes: dict[str, Any]


def main(argv: Sequence[str] | None = None) -> int:
    """Run `latentplan train | eval | distill | goals | export | doctor` and return the exit code."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    command = arguments[0] if arguments else "--help"
    if command == "--version":
        print(f"latentplan {__version__}")
        return 0
    if command in ("-h", "--help"):
        print(f"usage: latentplan [--version] {{{','.join(COMMANDS)}}} ...\n")
        print("  train    learn to control a body from pixels (train --help lists every setting)")
        print("  eval     run a trained agent in closed loop and film it")
        print("  distill  teach a trained agent's actor what its planner does")
        print("  goals    teach a trained agent to pursue goals that are named later")
        print("  export   write the actor as a program that runs without this package")
        print("  doctor   report versions, device and renderer, and what to do about what is wrong")
        return 0
    commands = {
        "train": _train,
        "eval": _evaluate,
        "distill": _distill,
        "goals": _goals,
        "export": _export,
        "doctor": _doctor,
    }
    return run_guarded(commands.get(command, lambda _: raise_unknown("command", command, COMMANDS)), arguments[1:])


def train_main(argv: Sequence[str] | None = None) -> int:
    """Run `scripts/train.py` and return the exit code: 0, 2 for bad input, 130 when interrupted."""
    return run_guarded(_train, sys.argv[1:] if argv is None else argv)


def run_guarded(command: Callable[[Sequence[str]], int], argv: Sequence[str]) -> int:
    """Run a command; what the user got wrong becomes one line on stderr and exit code 2."""
    try:
        try:
            return command(argv)
        finally:
            sys.stdout.flush()
    except UserError as error:
        print(f"error: {' '.join(str(error).split())}", file=sys.stderr)
        return 2
    except FloatingPointError as error:
        print(f"error: {' '.join(str(error).split())}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        return 130
    except BrokenPipeError:  # as in `train.py --help | head`: what read the output has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 141
    except OSError as error:
        if error.errno != errno.ENAMETOOLONG:
            raise
        print(f"error: a file name is too long: {str(error.filename)[:80]}...", file=sys.stderr)
        return 2


def parse_train(argv: Sequence[str]) -> TrainCommand:
    """Read the command line of a training run.

    Raises:
        UserError: A flag, file, key or value is wrong; the message says what to give instead.
    """
    settings = [f"--{section}.{name}" for section in SECTIONS for name in field_names(section)]
    flags = read_flags(argv, [*SHORT_FLAGS, *OTHER_FLAGS, *settings])
    if "--resume" in flags:
        return _parse_resume(flags)
    preset = flags.get("--preset", "auto")
    if preset not in PRESETS:
        raise_unknown("preset", preset, PRESETS)
    config_file = read_layer(Path(flags["--config"])) if "--config" in flags else {}
    return TrainCommand(compose(config_file, _flag_layer(flags), preset), None, {})


def read_flags(argv: Sequence[str], known: Iterable[str], joined: Mapping[str, str] | None = None) -> dict[str, str]:
    """Split `--name value` and `--name=value` into a dictionary; the last of a repeated flag wins.

    Args:
        argv: The words of the command line.
        known: Every flag there is.
        joined: Flags whose values add up when they are repeated, and what stands between them.

    Raises:
        UserError: A flag is unknown (the nearest known one is named) or has no value.
    """
    known = list(known)
    flags: dict[str, str] = {}
    words = iter(argv)
    for word in words:
        name, equals, value = word.partition("=")
        if not name.startswith("--"):
            raise UserError(f"unexpected argument {word!r}; settings are given as --name value")
        if name not in known:
            raise_unknown("flag", name, known)
        value = value if equals else next(words, "--")
        if not equals and value.startswith("--"):
            raise UserError(f"flag {name} needs a value")
        if name in flags and name in (joined or {}):
            value = f"{flags[name]}{(joined or {})[name]}{value}"
        flags.pop(name, None)
        flags[name] = value
    return flags


def _train(argv: Sequence[str]) -> int:
    if "--version" in argv:
        return main(["--version"])
    if "-h" in argv or "--help" in argv:
        print(_train_help())
        return 0
    command = parse_train(argv)
    from latentplan.training import resume, train

    if command.resume_dir is None:
        return train(command.config).exit_code
    return resume(command.resume_dir, **command.changes).exit_code


def _evaluate(argv: Sequence[str]) -> int:
    from latentplan.commands.evaluate import main as evaluate_main

    return evaluate_main(argv)


def _distill(argv: Sequence[str]) -> int:
    from latentplan.commands.distill import main as distill_main

    return distill_main(argv)


def _goals(argv: Sequence[str]) -> int:
    from latentplan.commands.goals import main as goals_main

    return goals_main(argv)


def _export(argv: Sequence[str]) -> int:
    if "-h" in argv or "--help" in argv:
        print("usage: latentplan export --checkpoint DIR --out FILE [--format pt2|onnx]\n")
        print("Write the actor as a program: frame, belief and last action in, action and belief out.\n")
        for flag, (metavar, meaning) in EXPORT_FLAGS.items():
            print(f"  {flag + ' ' + metavar:<18}  {meaning}")
        return 0
    flags = read_flags(argv, EXPORT_FLAGS)
    missing = [flag for flag in ("--checkpoint", "--out") if flag not in flags]
    if missing:
        raise UserError(f"flag {missing[0]} is missing; give {EXPORT_FLAGS[missing[0]][1]}")
    from latentplan.agents.export import FORMATS, export_actor

    file_format = flags.get("--format", "pt2")
    if file_format not in FORMATS:
        raise_unknown("format", file_format, FORMATS)
    path = export_actor(flags["--checkpoint"], flags["--out"], file_format)
    print(f"wrote {path} ({path.stat().st_size / 2**20:.1f} MiB)")
    return 0


def _doctor(argv: Sequence[str]) -> int:
    if "-h" in argv or "--help" in argv:
        print("usage: latentplan doctor\n\nReports versions, device, renderer and milliseconds per frame.")
        return 0
    read_flags(argv, [])
    from latentplan.commands import doctor

    return doctor.run_doctor()


def _train_help() -> str:
    parser = settings_parser()
    parser.description = "Learn to control a simulated body from pixels, then evaluate and film it."
    parser.epilog = "Values shown are the defaults before configs/<domain>.yaml and the preset are laid over them."
    for flag, meaning in {**{name: text for name, (_, text) in SHORT_FLAGS.items()}, **OTHER_FLAGS}.items():
        parser.add_argument(flag, metavar=METAVARS.get(flag, flag[2:].upper()), default=SUPPRESS, help=meaning)
    parser.add_argument("--version", action="store_true", default=SUPPRESS, help="print the version and exit")
    return parser.format_help()


def _parse_resume(flags: dict[str, str]) -> TrainCommand:
    for flag in flags:
        if flag not in ("--resume", *RESUMABLE):
            raise UserError(f"{flag} cannot be given with --resume; only {', '.join(RESUMABLE)} can")
    folder = Path(flags["--resume"])
    if not (folder / "config.yaml").is_file():
        raise UserError(f"nothing to resume in {folder}: give the folder of a run, which holds config.yaml")
    layer = _flag_layer(flags)
    given = build_config(layer).run
    changes = {name: getattr(given, name) for name in layer.get("run", {})}
    return TrainCommand(read_config(folder / "config.yaml"), folder, changes)


def _flag_layer(flags: dict[str, str]) -> Layer:
    layer: Layer = {}
    for flag, value in flags.items():
        if flag not in OTHER_FLAGS:
            section, name = SHORT_FLAGS.get(flag, (flag[2:],))[0].split(".")
            layer.setdefault(section, {})[name] = value
    return layer


def use_device(name: str, threads: int | None) -> str:
    """`cpu` or `cuda`, as `--device` means it; sets `--threads` on the way, where it was given.

    Raises:
        UserError: The device cannot be used.
    """
    import torch

    if threads is not None:
        if not 1 <= threads <= MAX_THREADS:
            raise UserError(f"--threads must lie in 1 to {MAX_THREADS}, got {threads}")
        torch.set_num_threads(threads)
    if name == "cuda" and not torch.cuda.is_available():
        raise UserError("device 'cuda' is not usable here; give --device cpu")
    return ("cuda" if torch.cuda.is_available() else "cpu") if name == "auto" else name
