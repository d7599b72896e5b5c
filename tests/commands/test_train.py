"""Flags and files become one Config; every mistake becomes one line and exit code 2."""

import dataclasses
import random

import pytest
import yaml

from latentplan import __version__
from latentplan.commands.main import OTHER_FLAGS, SHORT_FLAGS, main, parse_train, run_guarded, train_main
from latentplan.config import LATENT_DIM, Config, UserError
from latentplan.config import files as compose

SETTINGS = [f"--{section}.{name}" for section in compose.SECTIONS for name in compose.field_names(section)]
CONFIG_FILES = sorted(path.stem for path in compose.config_folder().glob("*.yaml"))
TASKS = {
    "walker": ("walk", 2),
    "cartpole": ("swingup", 8),
    "reacher": ("easy", 4),
    "cheetah": ("run", 4),
    "finger": ("spin", 2),
    "ball_in_cup": ("catch", 4),
    "pendulum": ("swingup", 4),
}


def parse(line):
    return parse_train(line.split()).config


@pytest.fixture
def config_file(tmp_path):
    def write(text):
        path = tmp_path / "mine.yaml"
        path.write_text(text)
        return path

    return write


def test_defaults_are_walker_walk_on_the_presets_budget():
    config = parse("--preset cpu")
    assert (config.env.domain, config.env.task, config.run.minutes, config.run.frames) == ("walker", "walk", 75, None)


@pytest.mark.parametrize(("domain", "task", "action_repeat"), [(d, *rest) for d, rest in TASKS.items()])
def test_domains_bring_their_usual_task_and_action_repeat(domain, task, action_repeat):
    env = parse(f"--domain {domain}").env
    assert (env.domain, env.task, env.action_repeat) == (domain, task, action_repeat)


def test_a_domain_without_a_file_runs_on_defaults():
    assert parse("--domain fish --preset cpu").env == dataclasses.replace(Config().env, domain="fish")


def test_the_last_of_a_repeated_flag_wins():
    assert parse("--domain walker --domain cartpole --env.domain=reacher").env.domain == "reacher"
    assert parse("--env.domain reacher --domain cartpole").env.task == "swingup"


def test_file_beats_preset_and_flags_beat_the_file(config_file):
    path = config_file("env: {action_repeat: 3, camera: 1}\nlearning: {batch_size: 5}\n")  # the preset has 32
    config = parse(f"--preset gpu --config {path} --env.camera 0")
    assert (config.env.action_repeat, config.env.camera) == (3, 0)
    assert (config.learning.batch_size, config.learning.imagination_starts) == (5, 512)


def test_preset_beats_domain_and_task_beats_domain(tmp_path, monkeypatch):
    layers = {"default": "1", "cartpole": "2", "cartpole-balance": "3", "cpu": "4"}
    for depth, stem in enumerate(layers):
        names = ["batch_size", "sequence_length", "imagination_horizon", "imagination_starts"][depth:]
        text = f"learning: {{{', '.join(f'{name}: {layers[stem]}' for name in names)}}}\n"
        (tmp_path / f"{stem}.yaml").write_text(text + ("env: {domain: cartpole}\n" if stem == "default" else ""))
    monkeypatch.setattr(compose, "config_folder", lambda: tmp_path)
    learning = parse("--preset cpu --task balance").learning
    values = (learning.batch_size, learning.sequence_length, learning.imagination_horizon, learning.imagination_starts)
    assert values == (1, 2, 3, 4)


def test_a_budget_replaces_the_other_kind():
    frames = parse("--preset cpu --frames 1000").run
    both = parse("--preset cpu --frames 1000 --minutes 3").run
    assert (frames.frames, frames.minutes) == (1000, None)
    assert (both.frames, both.minutes) == (1000, 3)


def test_whole_numbers_may_be_written_as_floats(config_file):
    assert parse("--frames 1e5").run.frames == 100_000
    assert parse(f"--config {config_file('run: {frames: 2e3}')}").run.frames == 2000


def test_values_take_the_types_of_their_fields():
    config = parse("--planner.warm_start false --model.encoder_channels [8,16] --learning.free_nats 1e-3 --run-dir 7")
    assert config.planner.warm_start is False
    assert config.model.encoder_channels == (8, 16)
    assert (config.learning.free_nats, config.run.run_dir) == (1e-3, "7")


def test_auto_takes_the_preset_of_the_machine(monkeypatch):
    monkeypatch.setattr(compose, "has_cuda", lambda: True)
    assert parse("").learning == parse("--preset gpu").learning
    assert parse("--device cpu").learning == parse("--preset cpu").learning != parse("--preset gpu").learning
    monkeypatch.setattr(compose, "has_cuda", lambda: False)
    assert parse("").learning == parse("--preset cpu").learning


@pytest.mark.parametrize("stem", CONFIG_FILES)
def test_every_shipped_file_is_valid(stem):
    compose.build_config(compose.read_layer(compose.config_folder() / f"{stem}.yaml"))


def test_presets_differ_only_in_sizes_budget_and_where_learning_lives():
    sizes = {
        "model": {"deter_dim", "hidden_dim", "encoder_channels", "decoder_channels"},
        "planner": {"num_samples", "num_elites", "num_policy_samples"},
        "learning": {"batch_size", "sequence_length", "imagination_starts", "cuda_graph"},
        "replay": {"on_device"},
        "run": {"minutes", "threads"},
    }
    for preset in ("cpu", "gpu"):
        layer = compose.read_layer(compose.config_folder() / f"{preset}.yaml")
        assert all(set(fields) <= sizes.get(section, set()) for section, fields in layer.items())
        assert parse(f"--preset {preset}").model.latent_dim == LATENT_DIM == 32


def test_a_config_survives_a_round_trip_through_yaml(tmp_path):
    config = parse("--domain cartpole --preset gpu --learning.free_nats 1e-7 --model.encoder_channels [8,16]")
    compose.dump_config(config, tmp_path / "config.yaml")
    assert compose.read_config(tmp_path / "config.yaml") == config


def test_resuming_takes_saved_settings_and_hands_on_the_changes(tmp_path):
    saved = parse("--domain cartpole --seed 3")
    compose.dump_config(saved, tmp_path / "config.yaml")
    command = parse_train(["--resume", str(tmp_path), "--frames", "2e5", "--device", "cpu"])
    assert (command.config, command.resume_dir) == (saved, tmp_path)
    assert command.changes == {"frames": 200_000, "device": "cpu"}


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("--planer.horizon 3", "did you mean '--planner.horizon'?"),
        ("--planner.horizn=3", "did you mean '--planner.horizon'?"),
        ("--domian walker", "did you mean '--domain'?"),
        ("--domain walkr", "did you mean 'walker'?"),
        ("--preset gpuu", "did you mean 'gpu'?"),
        ("--qqq 1", "--help lists all"),
        ("--planner.horizon x", "planner.horizon must be a whole number, got 'x'"),
        ("--planner.horizon 2.5", "planner.horizon must be a whole number, got '2.5'"),
        ("--planner.horizon null", "planner.horizon must be a whole number"),
        ("--frames many", "run.frames must be a whole number or null"),
        ("--planner.warm_start 1", "planner.warm_start must be true or false"),
        ("--model.encoder_channels 1,2", "model.encoder_channels must be a list such as [16, 32]"),
        ("--collection.goals speed", 'collection.goals must be a list such as ["speed'),
        ("--planner.noise_beta 500", "planner.noise_beta must be in [0.0, 100.0]"),
        ("--planner.min_std 1e300", "planner.min_std must be in"),
        ("--planner.num_elites 999", "planner.num_elites (999)"),
        ("--env.render_quality fats", "env.render_quality must be one of exact, fast, fastest"),
        ("--minutes nan", "run.minutes must be finite"),
        ("--device cuba", "run.device must be one of auto, cpu, cuda"),
        ("--frames", "flag --frames needs a value"),
        ("--frames --seed 3", "flag --frames needs a value"),
        ("cartpole", "unexpected argument 'cartpole'"),
        ("--config missing.yaml", "cannot read missing.yaml"),
        ("--resume nowhere", "nothing to resume in nowhere"),
        ("--resume nowhere --seed 3", "--seed cannot be given with --resume"),
    ],
)
def test_bad_flags_get_one_line_and_exit_code_two(line, expected, capsys):
    assert_one_line(line.split(), expected, capsys)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("planer: {horizon: 3}", "unknown section in {path}: 'planer'; did you mean 'planner'?"),
        ("planner: {horizn: 3}", "unknown setting in {path}: 'planner.horizn'; did you mean 'planner.horizon'?"),
        ("planner: {horizon: [1]}", "planner.horizon must be a whole number, got [1]"),
        ("planner: 3", "section planner must hold settings"),
        ("- 1", "must hold sections"),
        ("env: {domain: walkr}", "did you mean 'walker'?"),
        ("env: [", "not valid YAML"),
        ("env: !!python/object:os.system {}", "not valid YAML"),
        ("1: {2: 3}", "unknown section"),
    ],
)
def test_bad_files_get_one_line_and_exit_code_two(text, expected, config_file, capsys):
    path = config_file(text)
    assert_one_line(["--config", str(path)], expected.replace("{path}", str(path)), capsys)


def test_a_binary_file_is_no_config(tmp_path, capsys):
    (tmp_path / "config.yaml").write_bytes(b"\xff\xfe\x00\x80")
    assert_one_line(["--config", str(tmp_path / "config.yaml")], "not a text file", capsys)


def test_unknown_commands_name_the_nearest(capsys):
    assert main(["trian"]) == 2
    assert "did you mean 'train'?" in capsys.readouterr().err


def test_version_and_help_answer(capsys):
    assert main(["--version"]) == 0
    assert train_main(["--version"]) == 0
    assert capsys.readouterr().out == f"latentplan {__version__}\n" * 2
    assert main(["--help"]) == 0
    out = capsys.readouterr().out
    assert all(f"  {command} " in out for command in ("train", "eval", "doctor"))


def test_help_lists_every_flag_with_its_meaning(capsys):
    assert train_main(["--help"]) == 0
    text = capsys.readouterr().out
    assert all(f"{flag} " in text for flag in (*SETTINGS, *SHORT_FLAGS, *OTHER_FLAGS))
    assert "Model steps that a plan looks ahead." in text
    assert "--planner " not in text


@pytest.mark.parametrize("arguments", ["['--help']", "['--planer.horizon', '3']", "['--domain', 'walkr']"])
def test_parsing_imports_no_heavy_library(arguments, run_python):
    code = (
        "import sys; from latentplan.commands.main import train_main\n"
        f"train_main({arguments})\n"
        "print(*[m for m in ('torch', 'lightning', 'dm_control', 'mujoco', 'numpy', 'cv2') if m in sys.modules], '|')"
    )
    assert run_python("-c", code).stdout.splitlines()[-1] == "|"


def test_the_script_runs_from_any_folder(run_python, root, tmp_path):
    result = run_python(root / "scripts" / "train.py", "--domain", "cartpol", cwd=tmp_path)
    assert (result.returncode, result.stdout) == (2, "")
    assert result.stderr == "error: unknown domain 'cartpol'; did you mean 'cartpole'?\n"


def test_the_domains_are_those_of_the_suite(run_python):
    code = "from dm_control import suite; print(*sorted(suite._DOMAINS))"
    result = run_python("-c", f"import os; os.environ['MUJOCO_GL'] = 'disable'; {code}")
    assert result.stdout.split() == sorted(compose.DOMAINS), result.stderr


def test_random_flags_never_end_in_a_traceback():
    fuzz(seed=0, rounds=60)


@pytest.mark.soak
def test_many_random_flags_never_end_in_a_traceback():
    fuzz(seed=1, rounds=4_000)


def fuzz(seed, rounds):
    """Parse random flags and values: each gives a Config or a UserError, nothing else."""
    draw = random.Random(seed)
    flags = [*SETTINGS, *SHORT_FLAGS, "--preset", "--config", "--nonsense"]
    values = [
        "",
        "0",
        "-1",
        "1e999",
        ".nan",
        "nan",
        "[]",
        "[1",
        "{a: 1}",
        "null",
        "true",
        "x",
        "@",
        "\0",
        "é",
        "1" * 400,
    ]
    for _ in range(rounds):
        argv = [text for _ in range(draw.randint(1, 3)) for text in (draw.choice(flags), draw.choice(values))]
        try:
            assert isinstance(parse_train(argv).config, Config)
        except UserError as error:
            assert str(error)


def assert_one_line(argv, expected, capsys):
    """The command line refuses: exit code 2, nothing on stdout, one line on stderr that says why."""
    assert train_main(argv) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.count("\n") == 1
    assert expected in captured.err


def test_dumped_yaml_is_plain(tmp_path):
    compose.dump_config(Config(), tmp_path / "config.yaml")
    assert list(yaml.safe_load((tmp_path / "config.yaml").read_text())) == list(compose.SECTIONS)


def test_what_diverges_ends_in_one_line(capsys):
    def diverge(argv):
        raise FloatingPointError("the gradient is not finite\nat update 1 (loss inf)")

    assert run_guarded(diverge, []) == 2
    said = capsys.readouterr().err
    assert said.startswith("error: the gradient is not finite at update 1") and said.count("\n") == 1
