"""Values of the benchmarks' flags, checked before any work is done."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from latentplan.commands.main import use_device
from latentplan.config import DEVICES, Config, UserError, output_file
from latentplan.config.files import PRESETS, Layer, compose, raise_unknown

if TYPE_CHECKING:
    import torch

MOST_DIGITS = 18
Flags = Mapping[str, str]

DEVICE_FLAGS = {
    "--device": ("|".join(DEVICES), "where to compute (auto: cuda where usable)"),
    "--threads": ("T", "CPU threads (torch's own choice)"),
}
COMPOSE_FLAGS = {
    "--domain": ("D", "domain of dm_control.suite, whose settings hold (walker)"),
    "--preset": ("|".join(PRESETS), "machine class, as in train.py (auto)"),
    "--action-dim": ("N", "size of the action; unless given, the simulator is asked"),
}

SEARCH_FLAGS = {
    "--samples": ("N", "candidates per iteration (500)"),
    "--horizon": ("H", "model steps of each candidate (20)"),
    "--iterations": ("I", "refits of each search (5)"),
}


OUTPUTS = ("--json", "--csv", "--plot", "--scaling")


def whole_number(flags: Flags, name: str, default: int, least: int = 1) -> int:
    """The whole number that a flag gives.

    Raises:
        UserError: It is none, or below `least`.
    """
    text = flags.get(name, str(default))
    if not text.isascii() or not text.isdigit() or len(text) > MOST_DIGITS or int(text) < least:
        raise UserError(f"{name} must be a whole number of at least {least}, got {text!r}")
    return int(text)


def search_sizes(flags: Flags) -> dict[str, int]:
    """Samples, horizon and iterations of a search, by `SEARCH_FLAGS`.

    Raises:
        UserError: One of them is no whole number, or too small.
    """
    defaults = (("samples", 500, 2), ("horizon", 20, 1), ("iterations", 5, 1))
    return {name: whole_number(flags, f"--{name}", default, least=least) for name, default, least in defaults}


def positive_number(flags: Flags, name: str, default: float) -> float:
    """The number above 0 that a flag gives.

    Raises:
        UserError: It is none.
    """
    text = flags.get(name, str(default))
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0.0 < value < math.inf:
        raise UserError(f"{name} must be a number above 0, got {text!r}")
    return value


def choice(flags: Flags, name: str, default: str, allowed: Sequence[str]) -> str:
    """The word that a flag gives.

    Raises:
        UserError: It is not among the allowed ones.
    """
    text = flags.get(name, default)
    if text not in allowed:
        raise_unknown(name.lstrip("-"), text, allowed)
    return text


def words(flags: Flags, name: str, default: str) -> list[str]:
    """The distinct words of a list that commas separate, in order.

    Raises:
        UserError: There is none.
    """
    found = list(dict.fromkeys(word.strip() for word in flags.get(name, default).split(",") if word.strip()))
    if not found:
        raise UserError(f"{name} must name at least one, separated by commas, got {flags.get(name, default)!r}")
    return found


def numbers(flags: Flags, name: str, default: str) -> list[int]:
    """The distinct whole numbers of a list that commas separate.

    Raises:
        UserError: One of them is no whole number.
    """
    return [whole_number({name: word}, name, 0, least=0) for word in words(flags, name, default)]


def output_path(flags: Flags, name: str) -> Path | None:
    """The file that a flag names, or None; tried before any work is spent on it.

    Raises:
        UserError: It cannot be written, or another flag names it too.
    """
    if name not in flags:
        return None
    path = output_file(Path(flags[name]), name)
    for other in OUTPUTS:
        if other != name and other in flags and Path(flags[other]).resolve() == path.resolve():
            raise UserError(f"{name} and {other} name the same file; give two")
    return path


def settings_layer(flags: Flags) -> Layer:
    """The settings among the flags, `--section.name value`, by section and field."""
    layer: Layer = {}
    for flag, value in flags.items():
        section, dot, name = flag[2:].partition(".")
        if dot:
            layer.setdefault(section, {})[name] = value
    return layer


def composed_config(flags: Flags) -> Config:
    """The settings that a run of `--domain` with `--preset` and `--device` would have.

    Raises:
        UserError: The domain is unknown or a value is not allowed.
    """
    layer = settings_layer(flags)
    layer.setdefault("env", {})["domain"] = flags.get("--domain", "walker")
    layer.setdefault("run", {})["device"] = choice(flags, "--device", "auto", DEVICES)
    return compose({}, layer, choice(flags, "--preset", "auto", PRESETS))


def action_size(flags: Flags, config: Config) -> int:
    """The size of the action: `--action-dim`, else what the environment says.

    Raises:
        UserError: The environment cannot be made.
    """
    if "--action-dim" in flags:
        return whole_number(flags, "--action-dim", 1)
    from latentplan.envs import make_env

    env = make_env(config.env)
    try:
        return int((env.action_space.shape or (1,))[0])
    finally:
        env.close()


def choose_device(flags: Flags) -> torch.device:
    """The device that `--device` means, with `--threads` set.

    Raises:
        UserError: The device cannot be used.
    """
    name = choice(flags, "--device", "auto", DEVICES)
    threads = whole_number(flags, "--threads", 1) if "--threads" in flags else None
    import torch

    return torch.device(use_device(name, threads))
