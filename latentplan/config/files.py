"""Settings from several sources, laid over one another into one validated `Config`.

Later sources win: the defaults of `latentplan/config`, `configs/default.yaml`, `configs/<domain>.yaml`,
`configs/<domain>-<task>.yaml`, `configs/<preset>.yaml`, the file given with `--config`, the command line.
Nothing here imports torch, lightning or a simulator.
"""

from __future__ import annotations

import argparse
import dataclasses
import difflib
import importlib.metadata
import math
import os
import re
import types
import typing
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from latentplan.config import Config, UserError, to_dict
from latentplan.config.suites import DEFAULT_SUITE, SUITES, find_suite

if typing.TYPE_CHECKING:
    from jsonargparse import ArgumentParser

Layer = dict[str, dict[str, Any]]

SECTIONS: dict[str, Any] = {field.name: field.default_factory for field in dataclasses.fields(Config)}
PRESETS = ("auto", "cpu", "gpu")
DOMAINS = tuple(SUITES[DEFAULT_SUITE].tasks)
TYPE_WORDS = {int: "a whole number", float: "a number", bool: "true or false", str: "text", type(None): "null"}


def compose(config_file: Layer, flags: Layer, preset: str = "auto") -> Config:
    """Lay defaults, domain, task, preset, the user's file and the flags over one another.

    Raises:
        UserError: The suite or the domain is unknown or a value is not allowed.
    """
    default = read_layer(config_folder() / "default.yaml")
    chosen = _overlay(default, config_file, flags)
    domain = chosen["env"]["domain"]
    domains = tuple(find_suite(chosen["env"].get("suite", DEFAULT_SUITE)).tasks)
    if domain not in domains:
        raise_unknown("domain", domain, domains)
    domain_layer = _read_optional(domain)
    task = chosen["env"].get("task") or domain_layer.get("env", {}).get("task")
    if preset == "auto":
        preset = "gpu" if chosen.get("run", {}).get("device") != "cpu" and has_cuda() else "cpu"
    preset_layer = read_layer(config_folder() / f"{preset}.yaml")
    layers = (default, domain_layer, _read_optional(f"{domain}-{task}"), preset_layer, config_file, flags)
    return build_config(_overlay(*layers))


def build_config(layer: Layer) -> Config:
    """The settings a layer describes, typed and validated; absent fields take their defaults.

    Args:
        layer: Values by section and field; strings are read as they would be on the command line.

    Raises:
        UserError: A value has the wrong type or is not allowed; the message names the setting.
    """
    values = {
        section: {name: _number(section, name, value) for name, value in fields.items()}
        for section, fields in layer.items()
    }
    try:
        parsed = settings_parser().parse_object(values)
    except argparse.ArgumentError as error:
        key = re.search(r'"(\w+)\.(\w+)', str(error))
        raise _wrong_type(key[1], key[2], values) if key else UserError(str(error)) from None
    sections = {}
    for section, fields in values.items():
        typed = {name: parsed[section][name] for name in fields}
        for name in fields:
            if typed[name] is None and type(None) not in _alternatives(_hint(section, name)):
                raise _wrong_type(section, name, values)
        try:
            sections[section] = SECTIONS[section](**typed)
        except ValueError as error:
            raise UserError(f"{section}.{error}") from None
    return Config(**sections)


def read_config(path: Path) -> Config:
    """The settings saved by `dump_config`.

    Raises:
        UserError: The file is missing, malformed, or holds an unknown key or bad value.
    """
    return build_config(read_layer(Path(path)))


def dump_config(config: Config, path: Path) -> None:
    """Write every setting as YAML, in the order of `latentplan/config`; the file is replaced whole."""
    import yaml

    part = path.with_name(f"{path.name}.part")
    part.write_text(yaml.safe_dump(to_dict(config), sort_keys=False))
    part.replace(path)


def read_layer(path: Path) -> Layer:
    """The sections and settings that a YAML file names.

    Raises:
        UserError: The file is missing or malformed, or names an unknown section or setting.
    """
    import yaml

    try:
        layer = yaml.safe_load(path.read_text()) or {}
    except (OSError, ValueError) as error:
        raise UserError(f"cannot read {path}: {getattr(error, 'strerror', None) or 'not a text file'}") from None
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        where = f"line {mark.line + 1}: " if mark else ""
        raise UserError(f"{path} is not valid YAML: {where}{getattr(error, 'problem', None) or error}") from None
    if not isinstance(layer, dict):
        raise UserError(f"{path} must hold sections ({', '.join(SECTIONS)}), got {layer!r}")
    for section, fields in layer.items():
        if section not in SECTIONS:
            raise_unknown(f"section in {path}:", section, SECTIONS)
        if not isinstance(fields, dict):
            raise UserError(f"{path}: section {section} must hold settings, got {fields!r}")
        for name in fields:
            if name not in field_names(section):
                keys = [f"{other}.{field}" for other in SECTIONS for field in field_names(other)]
                raise_unknown(f"setting in {path}:", f"{section}.{name}", keys)
    return layer


def settings_parser() -> ArgumentParser:
    """A parser whose types, defaults and help come from the dataclasses and their docstrings."""
    from jsonargparse import ArgumentParser

    parser = ArgumentParser(prog="train.py", usage="%(prog)s [--name value ...]", exit_on_error=False)
    for section, kind in SECTIONS.items():
        parser.add_argument(f"--{section}", type=kind)
        parser._option_string_actions[f"--{section}"].help = argparse.SUPPRESS
    return parser


def config_folder() -> Path:
    """The folder of the YAML files: beside the package in a checkout, inside it once installed."""
    package = Path(__file__).resolve().parent.parent
    checkout = package.parent / "configs"
    return checkout if (checkout / "default.yaml").is_file() else package / "configs"


def has_cuda() -> bool:
    """Whether an NVIDIA device and a torch build for it are there, found without importing torch."""
    if os.environ.get("CUDA_VISIBLE_DEVICES") in ("", "-1"):
        return False
    nodes = ("/dev/nvidiactl", "/dev/dxg", "/proc/driver/nvidia/version")
    try:
        return any(Path(node).exists() for node in nodes) and "+cpu" not in importlib.metadata.version("torch")
    except importlib.metadata.PackageNotFoundError:
        return False


def field_names(section: str) -> list[str]:
    """The settings of a section, in the order of its dataclass."""
    return [field.name for field in dataclasses.fields(SECTIONS[section])]


def raise_unknown(what: str, name: str, choices: Iterable[str]) -> typing.NoReturn:
    """Raise a `UserError` that names the nearest choice, or all of them where none is near."""
    choices = list(choices)
    nearest = difflib.get_close_matches(str(name), choices, n=1, cutoff=0.5)
    few = f"; available: {', '.join(choices)}" if len(choices) <= 20 else "; --help lists all"
    raise UserError(f"unknown {what} {name!r}" + (f"; did you mean {nearest[0]!r}?" if nearest else few))


def _read_optional(stem: str) -> Layer:
    path = config_folder() / f"{stem}.yaml"
    return read_layer(path) if path in config_folder().glob("*.yaml") else {}


def _overlay(*layers: Layer) -> Layer:
    merged: Layer = {}
    for layer in layers:
        run = layer.get("run", {})
        for given, other in (("frames", "minutes"), ("minutes", "frames")):
            if given in run and other not in run:  # a budget replaces the other kind, set by an earlier layer
                merged.get("run", {}).pop(other, None)
        for section, fields in layer.items():
            merged[section] = {**merged.get(section, {}), **fields}
    return merged


def _hint(section: str, name: str) -> Any:
    return typing.get_type_hints(SECTIONS[section])[name]


def _number(section: str, name: str, value: Any) -> Any:
    """A value on its way to a numeric field: `1e5` and `100000.0` whole where an integer is wanted."""
    wanted = {int, float} & set(_alternatives(_hint(section, name)))
    if not wanted or not isinstance(value, str | int | float):
        return value
    try:
        number = float(value)
    except ValueError:
        return value
    except OverflowError:
        number = math.inf
    if not math.isfinite(number):
        raise UserError(f"{section}.{name} must be finite, got {str(value):.40}")
    return int(number) if int in wanted and number.is_integer() and not isinstance(value, int) else value


def _wrong_type(section: str, name: str, values: Layer) -> UserError:
    hint = _hint(section, name)
    items = '["speed -> 1.0"]' if str in typing.get_args(hint) else "[16, 32]"
    wanted = " or ".join(TYPE_WORDS.get(kind, f"a list such as {items}") for kind in _alternatives(hint))
    return UserError(f"{section}.{name} must be {wanted}, got {values[section].get(name)!r}")


def _alternatives(hint: Any) -> tuple[Any, ...]:
    """`int | None` as (int, NoneType); any other type alone."""
    return typing.get_args(hint) if isinstance(hint, types.UnionType) else (hint,)
