"""YAML files and flags laid over one another into one Config."""

import ast
import dataclasses
import re
from dataclasses import replace

import pytest
import yaml

from latentplan.config import LATENT_DIM, Config, EnvConfig, UserError, files, to_dict
from latentplan.config.files import (
    SECTIONS,
    build_config,
    compose,
    config_folder,
    dump_config,
    field_names,
    read_config,
    read_layer,
)
from latentplan.config.suites import DEFAULT_SUITE, SUITES, Suite, check_task

CONFIG_FILES = sorted(path.stem for path in config_folder().glob("*.yaml"))
SPECIALISED_FILES = sorted(path.stem for path in (config_folder() / "specialised").glob("*.yaml"))


@pytest.fixture
def write_yaml(tmp_path):
    """Write a YAML file and return its path."""

    def write(text, name="mine.yaml"):
        path = tmp_path / name
        path.write_text(text)
        return path

    return write


@pytest.mark.parametrize("domain", SUITES[DEFAULT_SUITE].tasks)
def test_every_task_has_the_same_settings_but_for_the_camera_of_its_body(domain):
    composed = compose({}, {"env": {"domain": domain}}, "cpu")
    usual = compose({}, {}, "cpu")
    task = check_task(DEFAULT_SUITE, domain)[0]
    body = replace(usual.env, domain=domain, task=task, camera=composed.env.camera)
    assert composed == replace(usual, env=body)


@pytest.mark.parametrize("stem", SPECIALISED_FILES)
def test_compose_lays_a_specialised_file_over_the_defaults(stem):
    layer = read_layer(config_folder() / "specialised" / f"{stem}.yaml")
    sections = to_dict(compose(layer, {"env": {"domain": stem}}, "cpu"))
    for section, fields in layer.items():
        assert {name: sections[section][name] for name in fields} == fields


def test_compose_takes_defaults_when_domain_has_no_file():
    composed = compose({}, {"env": {"domain": "fish"}}, "cpu")
    assert composed.env == EnvConfig(domain="fish", task=check_task(DEFAULT_SUITE, "fish")[0])
    for section in ("model", "planner", "learning", "collection", "replay", "evaluation"):
        assert getattr(Config(), section) == getattr(composed, section)


def test_compose_lays_flags_over_file_over_preset():
    config_file = {"env": {"action_repeat": 3, "camera": 1}, "learning": {"batch_size": 5}}
    config = compose(config_file, {"env": {"camera": 0}}, "gpu")
    assert (config.env.action_repeat, config.env.camera) == (3, 0)
    assert (config.learning.batch_size, config.learning.imagination_starts) == (5, 512)  # the preset has 32 and 512


def test_compose_lays_preset_over_task_over_domain_over_default(tmp_path, monkeypatch, write_yaml):
    layers = {"default": "1", "cartpole": "2", "cartpole-balance": "3", "cpu": "4"}
    for depth, stem in enumerate(layers):
        names = ["batch_size", "sequence_length", "imagination_horizon", "imagination_starts"][depth:]
        text = f"learning: {{{', '.join(f'{name}: {layers[stem]}' for name in names)}}}\n"
        write_yaml(text + ("env: {domain: cartpole}\n" if stem == "default" else ""), f"{stem}.yaml")
    monkeypatch.setattr(files, "config_folder", lambda: tmp_path)
    learning = compose({}, {"env": {"task": "balance"}}, "cpu").learning
    values = (learning.batch_size, learning.sequence_length, learning.imagination_horizon, learning.imagination_starts)
    assert values == (1, 2, 3, 4)


def test_compose_replaces_budget_of_the_other_kind():
    frames = compose({}, {"run": {"frames": 1000}}, "cpu").run
    both = compose({}, {"run": {"frames": 1000, "minutes": 3}}, "cpu").run
    assert (frames.frames, frames.minutes) == (1000, None)
    assert (both.frames, both.minutes) == (1000, 3)


def test_compose_auto_takes_preset_of_the_machine(monkeypatch):
    cpu, gpu = (compose({}, {}, preset).learning for preset in ("cpu", "gpu"))
    monkeypatch.setattr(files, "has_cuda", lambda: True)
    assert compose({}, {}).learning == gpu
    assert compose({}, {"run": {"device": "cpu"}}).learning == cpu != gpu
    monkeypatch.setattr(files, "has_cuda", lambda: False)
    assert compose({}, {}).learning == cpu


@pytest.mark.parametrize(
    ("nodes", "visible", "expected"),
    [
        (["nvidia0", "nvidiactl"], None, True),
        (["nvidia0", "nvidiactl"], "NoDevFiles", False),
        (["nvidia0"], "", False),
        (["nvidiactl"], None, False),  # a driver without a device
        (["dxg"], None, False),  # Windows with a card of another maker
        (["dxg", "libcuda.so.1"], None, True),
    ],
)
def test_has_cuda_needs_a_device_that_this_process_may_use(nodes, visible, expected, tmp_path, monkeypatch):
    for name in nodes:
        (tmp_path / name).touch()
    monkeypatch.setattr(files, "NODES", tmp_path)
    monkeypatch.setattr(files, "WSL_LIBRARIES", tmp_path)
    monkeypatch.setattr(files.importlib.metadata, "version", lambda name: "2.11.0+cu130")
    if visible is None:
        monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)
    else:
        monkeypatch.setenv("CUDA_VISIBLE_DEVICES", visible)
    assert files.has_cuda() is expected


def test_presets_differ_only_in_sizes_budget_and_where_learning_lives():
    allowed = {
        "model": {"deter_dim", "hidden_dim", "encoder_channels", "decoder_channels"},
        "planner": {"num_samples", "num_elites", "num_policy_samples"},
        "learning": {"batch_size", "sequence_length", "imagination_starts", "cuda_graph"},
        "replay": {"on_device"},
        "run": {"minutes", "threads"},
    }
    for preset in ("cpu", "gpu"):
        layer = read_layer(config_folder() / f"{preset}.yaml")
        assert all(set(fields) <= allowed.get(section, set()) for section, fields in layer.items())
        assert compose({}, {}, preset).model.latent_dim == LATENT_DIM == 32


@pytest.mark.parametrize("stem", CONFIG_FILES)
def test_build_config_accepts_every_shipped_file(stem):
    build_config(read_layer(config_folder() / f"{stem}.yaml"))


def test_build_config_gives_values_the_types_of_their_fields():
    config = build_config(
        {
            "planner": {"warm_start": "false"},
            "model": {"encoder_channels": "[8,16]"},
            "learning": {"free_nats": "1e-3", "batch_size": 8.0},
            "run": {"frames": "1e5", "minutes": 3, "run_dir": "7"},
        }
    )
    assert config.planner.warm_start is False and config.model.encoder_channels == (8, 16)
    assert (config.learning.free_nats, config.learning.batch_size) == (1e-3, 8)
    assert (config.run.frames, config.run.minutes, config.run.run_dir) == (100_000, 3.0, "7")
    assert [type(value) for value in (config.run.frames, config.run.minutes)] == [int, float]


@pytest.mark.parametrize(
    ("key", "value", "expected"),
    [
        ("planner.horizon", "x", "planner.horizon must be a whole number, got 'x'"),
        ("planner.horizon", 2.5, "planner.horizon must be a whole number, got 2.5"),
        ("planner.horizon", True, "planner.horizon must be a whole number, got True"),
        ("planner.horizon", None, "planner.horizon must be a whole number, got None"),
        ("planner.horizon", [1], "planner.horizon must be a whole number, got [1]"),
        ("planner.horizon", "1" * 400, "planner.horizon must be a whole number, got '111"),
        ("learning.batch_size", 0, "learning.batch_size must be at least 1, got 0"),
        ("run.frames", "many", "run.frames must be a whole number or null, got 'many'"),
        ("run.minutes", float("nan"), "run.minutes must be a finite number or null, got nan"),
        ("run.minutes", 10**400, "run.minutes must be a finite number or null, got 1000"),
        ("planner.warm_start", "1", "planner.warm_start must be true or false, got '1'"),
        ("model.encoder_channels", "1,2", "model.encoder_channels must be a list such as [16, 32], got '1,2'"),
        ("collection.goals", "speed", "collection.goals must be a list such as [\"speed -> 1.0\"], got 'speed'"),
        ("env.render_quality", "fats", "env.render_quality must be one of exact, fast, fastest, got 'fats'"),
        ("planner.noise_beta", 500, "planner.noise_beta must be in [0.0, 100.0], got 500.0"),
        ("planner.horizn", 3, "unknown setting 'planner.horizn'; did you mean 'planner.horizon'?"),
    ],
)
def test_build_config_names_setting_value_and_what_is_allowed(key, value, expected):
    section, name = key.split(".")
    with pytest.raises(UserError) as error:
        build_config({section: {name: value}})
    assert expected in str(error.value) and len(str(error.value)) < 200


@pytest.mark.parametrize("config", [Config(), compose({}, {"model": {"encoder_channels": "[8, 16]"}}, "gpu")])
def test_read_config_inverts_dump_config(tmp_path, config):
    dump_config(config, tmp_path / "config.yaml")
    assert read_config(tmp_path / "config.yaml") == config
    assert list(yaml.safe_load((tmp_path / "config.yaml").read_text())) == list(SECTIONS)
    assert [path.name for path in tmp_path.iterdir()] == ["config.yaml"]


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("planer: {horizon: 3}", "unknown section in {path}: 'planer'; did you mean 'planner'?"),
        ("planner: {horizn: 3}", "unknown setting in {path}: 'planner.horizn'; did you mean 'planner.horizon'?"),
        ("planner: 3", "section planner must hold settings"),
        ("- 1", "must hold sections"),
        ("env: [", "not valid YAML"),
        ("env: !!python/object:os.system {}", "not valid YAML"),
        ("1: {2: 3}", "unknown section"),
        ("[" * 3000, "cannot read {path}"),
        (
            "planner: {horizon: 3}\nrun: {frames: 9}\nplanner: {num_samples: 64}",
            "{path}: line 3 gives 'planner' a second",
        ),
        ("run:\n  frames: 100\n  minutes: 1\n  frames: 200", "{path}: line 4 gives 'frames' a second time"),
    ],
)
def test_read_layer_refuses_malformed_files(text, expected, write_yaml):
    path = write_yaml(text)
    with pytest.raises(UserError) as error:
        read_layer(path)
    assert expected.replace("{path}", str(path)) in str(error.value)


def test_read_layer_refuses_missing_and_binary_files(tmp_path):
    with pytest.raises(UserError, match="cannot read .*missing.yaml: No such file"):
        read_layer(tmp_path / "missing.yaml")
    (tmp_path / "config.yaml").write_bytes(b"\xff\xfe\x00\x80")
    with pytest.raises(UserError, match="not a text file"):
        read_layer(tmp_path / "config.yaml")


def test_field_names_are_those_of_the_dataclasses():
    for section, kind in SECTIONS.items():
        assert field_names(section) == [field.name for field in dataclasses.fields(kind)]
    assert list(to_dict(Config())) == list(SECTIONS)


def test_tasks_are_those_of_the_suite(run_python):
    code = "from dm_control import suite; print(suite.TASKS_BY_DOMAIN)"
    result = run_python("-c", f"import os; os.environ['MUJOCO_GL'] = 'disable'; {code}")
    known = ast.literal_eval(result.stdout)
    assert {domain: sorted(tasks) for domain, tasks in known.items()} == {
        domain: sorted(tasks) for domain, tasks in SUITES[DEFAULT_SUITE].tasks.items()
    }


def test_usual_task_of_a_domain_comes_first():
    usual = {domain: tasks[0] for domain, tasks in SUITES[DEFAULT_SUITE].tasks.items()}
    domains = ("walker", "cartpole", "hopper", "humanoid", "dog", "fish", "humanoid_CMU")
    assert [usual[domain] for domain in domains] == ["walk", "swingup", "hop", "walk", "walk", "swim", "run"]


def test_domains_are_those_of_the_suite(run_python):
    code = "from dm_control import suite; print(*sorted(suite._DOMAINS))"
    result = run_python("-c", f"import os; os.environ['MUJOCO_GL'] = 'disable'; {code}")
    assert result.stdout.split() == sorted(files.DOMAINS), result.stderr


def test_suite_with_a_usual_task_alone_leaves_other_tasks_to_its_factory(monkeypatch):
    monkeypatch.setitem(SUITES, "lamps", Suite("nowhere:Lamp", {"lamp": "bright"}))
    assert check_task("lamps", "lamp") == check_task("lamps", "lamp", "dim") == ("bright",)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("replay: {demonstrations: episodes}", "replay.demonstrations must be a list of texts, such as [episodes]"),
        ('run: {logger: "tensorboard,csv"}', "run.logger must be a list of texts, such as [tensorboard, csv]"),
    ],
)
def test_text_in_place_of_a_list_in_a_file_is_refused_with_the_list_to_write(tmp_path, text, words):
    (tmp_path / "settings.yaml").write_text(text)
    with pytest.raises(UserError, match=re.escape(words)):
        compose(read_layer(tmp_path / "settings.yaml"), {}, "cpu")
