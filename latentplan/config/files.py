"""YAML files and flags, laid over one another into one validated `Config`.

Later sources win: the defaults of `latentplan/config`, `configs/default.yaml`, `configs/<domain>.yaml`,
`configs/<domain>-<task>.yaml`, `configs/<preset>.yaml`, the file given with `--config`, the command line.
Nothing here imports torch, lightning or a simulator.
"""

from __future__ import annotations

import dataclasses
import functools
import importlib.metadata
import os
from pathlib import Path
from typing import Any, Literal

from latentplan.config.checks import UserError, shown
from latentplan.config.earlier import as_saved, drop_removed
from latentplan.config.parsing import Setting, list_settings, raise_unknown, read_values
from latentplan.config.reading import read_yaml
from latentplan.config.settings import Config, by_key
from latentplan.config.suites import DEFAULT_SUITE, SUITES, check_task, find_suite
from latentplan.config.writing import write_whole

Layer = dict[str, dict[str, Any]]

SECTIONS: dict[str, Any] = {field.name: field.default_factory for field in dataclasses.fields(Config)}
Preset = Literal["auto", "cpu", "gpu"]
NODES, WSL_LIBRARIES = Path("/dev"), Path("/usr/lib/wsl/lib")
BUDGETS = ("frames", "minutes", "updates")  # of the section `run`
DOMAINS = tuple(SUITES[DEFAULT_SUITE].tasks)


def compose(config_file: Layer, flags: Layer, preset: str = "auto") -> Config:
    """Lay defaults, domain, task, preset, the user's file and the flags over one another.

    Raises:
        UserError: The suite, the domain or the task is unknown or a value is not allowed.
    """
    default = read_layer(config_folder() / "default.yaml")
    chosen = _overlay(default, config_file, flags)
    domain = chosen["env"]["domain"]
    suite = chosen["env"].get("suite", DEFAULT_SUITE)
    domains = tuple(find_suite(suite).tasks)
    if domain not in domains:
        raise_unknown("domain", domain, domains)
    domain_layer = _read_optional(domain)
    given = chosen["env"].get("task") or None
    usual, *_ = check_task(suite, domain, given)
    task = given or usual
    if preset == "auto":
        preset = "gpu" if chosen.get("run", {}).get("device") != "cpu" and has_cuda() else "cpu"
    preset_layer = read_layer(config_folder() / f"{preset}.yaml")
    layers = (default, domain_layer, _read_optional(f"{domain}-{task}"), preset_layer, config_file, flags)
    return build_config(_overlay(*layers, {"env": {"task": task}}))


def build_config(layer: Layer) -> Config:
    """The settings that a layer describes, typed and validated; absent fields take their defaults.

    Args:
        layer: Values by section and field; strings are read as they would be on the command line.

    Raises:
        UserError: A value has the wrong type or is not allowed; the message names the setting.
    """
    kept = {section: drop_removed(section, fields) for section, fields in layer.items()}
    given = by_key(kept)
    typed: Layer = {section: {} for section in kept}
    for key, value in read_values(_all_settings(), given).items():
        section, _, name = key.partition(".")
        typed[section][name] = value
    sections = {}
    for section, fields in typed.items():
        try:
            sections[section] = SECTIONS[section](**fields)
        except ValueError as error:
            raise UserError(f"{section}.{error}") from None
    return Config(**sections)


def read_config(path: Path) -> Config:
    """The settings saved by `dump_config`.

    Raises:
        UserError: The file is missing, malformed, or holds an unknown key or bad value.
    """
    return build_config({section: as_saved(section, fields) for section, fields in read_layer(Path(path)).items()})


def dump_config(config: Config, path: Path) -> None:
    """Write every setting as YAML, in the order of `latentplan/config`; the file is replaced whole."""
    write_whole(path, to_yaml(config))


def to_yaml(settings: Any) -> str:
    """A dataclass of settings, or a dictionary of them, as YAML."""
    import yaml

    return str(yaml.safe_dump(_plain(settings), sort_keys=False, allow_unicode=True))


def read_layer(path: Path) -> Layer:
    """The sections and settings that a YAML file names.

    Raises:
        UserError: The file is missing or malformed, or names an unknown section or setting.
    """
    layer = read_yaml(path) or {}
    if not isinstance(layer, dict):
        raise UserError(f"{path} must hold sections ({', '.join(SECTIONS)}), got {shown(layer)}")
    kept = {}
    for section, fields in layer.items():
        if section not in SECTIONS:
            raise_unknown(f"section in {path}:", section, SECTIONS)
        if not isinstance(fields, dict):
            raise UserError(f"{path}: section {section} must hold settings, got {shown(fields)}")
        kept[section] = drop_removed(section, fields)
        for name in kept[section]:
            if name not in field_names(section):
                raise_unknown(f"setting in {path}:", f"{section}.{name}", [setting.key for setting in _all_settings()])
    return kept


def config_folder() -> Path:
    """The folder of the YAML files: beside the package in a checkout, inside it once installed."""
    package = Path(__file__).resolve().parent.parent
    checkout = package.parent / "configs"
    return checkout if (checkout / "default.yaml").is_file() else package / "configs"


def has_cuda() -> bool:
    """Whether an NVIDIA device and a torch build for it are there, found without importing torch.

    Torch alone knows whether the device can be used; `train` asks it again.
    """
    if os.environ.get("CUDA_VISIBLE_DEVICES") in ("", "-1", "NoDevFiles"):  # the last is Slurm's
        return False
    has_device = any(NODES.glob("nvidia[0-9]*"))  # the driver's own files are also seen by containers without a device
    has_wsl = (NODES / "dxg").exists() and any(WSL_LIBRARIES.glob("libcuda.so*"))
    try:
        return (has_device or has_wsl) and "+cpu" not in importlib.metadata.version("torch")
    except importlib.metadata.PackageNotFoundError:
        return False


def field_names(section: str) -> list[str]:
    """The settings of a section, in the order of its dataclass."""
    return [setting.key.partition(".")[2] for setting in _all_settings() if setting.key.startswith(f"{section}.")]


@functools.cache
def _all_settings() -> list[Setting]:
    return list_settings(Config)


def _plain(value: Any) -> Any:
    """A value that YAML can write: dataclasses as dictionaries, tuples as lists, paths as text."""
    if dataclasses.is_dataclass(value):
        return {field.name: _plain(getattr(value, field.name)) for field in dataclasses.fields(value)}
    if isinstance(value, dict):
        return {name: _plain(inner) for name, inner in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(inner) for inner in value]
    return str(value) if isinstance(value, Path) else value


def _read_optional(stem: str) -> Layer:
    path = config_folder() / f"{stem}.yaml"
    return read_layer(path) if path in config_folder().glob("*.yaml") else {}


def _overlay(*layers: Layer) -> Layer:
    merged: Layer = {}
    for layer in layers:
        run = layer.get("run", {})
        if given := [name for name in BUDGETS if name in run]:  # budgets replace earlier budgets of other kinds
            for other in set(BUDGETS) - set(given):
                merged.get("run", {}).pop(other, None)
        for section, fields in layer.items():
            merged[section] = {**merged.get(section, {}), **fields}
    return merged
