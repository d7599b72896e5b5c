"""The command line of a training run: its settings, the changes that a resumed run accepts, and errors."""

from dataclasses import replace

import pytest

from latentplan.commands import train
from latentplan.commands.flags import read_request
from latentplan.commands.train import SHORT_FLAGS, Request, resolve
from latentplan.config import CollectionConfig, Config, ReplayConfig, RunConfig, UserError
from latentplan.config.files import compose, dump_config
from latentplan.config.run_folder import RUN_FILE, run_saves


def settings_of(line):
    return resolve(read_request(Request, line.split()))


def test_train_defaults_to_walker_walk_on_the_budget_of_the_preset():
    config = settings_of("--preset cpu")
    assert (config.env.domain, config.env.task, config.run.minutes, config.run.frames) == ("walker", "walk", 75, None)


def test_short_flags_set_the_settings_that_they_name():
    short = "--domain cartpole --task balance --frames 1e3 --minutes 2 --device cpu --seed 3 --run-dir here"
    long = short
    for key, flag in SHORT_FLAGS.items():
        long = long.replace(f"{flag} ", f"--{key} ")
    assert settings_of(short) == settings_of(long)
    assert settings_of(short).run.frames == 1000 and settings_of(short).env.task == "balance"


def test_short_and_long_flags_of_a_setting_replace_each_other():
    assert settings_of("--domain walker --domain cartpole --env.domain=reacher").env.domain == "reacher"
    assert settings_of("--env.domain reacher --domain cartpole").env.task == "swingup"


def test_flags_are_laid_over_the_file_and_the_preset(tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text("env: {action_repeat: 3, camera: 1}\nrun: {frames: 2e3}\n")
    found = settings_of(f"--preset gpu --config {path} --env.camera 0")
    assert found == compose(
        {"env": {"action_repeat": 3, "camera": 1}, "run": {"frames": 2000}}, {"env": {"camera": 0}}, "gpu"
    )


def save_settings(config, folder):
    """Writes the settings of a run and a save that holds nothing else."""

    def write(part):
        dump_config(config, part / RUN_FILE)
        return {}

    run_saves(folder).commit(write, {})
    dump_config(config, folder / RUN_FILE)


def test_resume_takes_saved_settings_with_the_given_changes(tmp_path):
    saved = settings_of("--domain cartpole --seed 3 --preset cpu")
    save_settings(saved, tmp_path)
    request = read_request(Request, ["--resume", str(tmp_path), "--frames", "2e5", "--device", "cpu"])
    assert request.settings["run"] == {"frames": 200_000, "device": "cpu"} and request.resume == tmp_path
    found = resolve(request)
    assert (found.run.frames, found.run.minutes, found.run.device, found.run.seed) == (200_000, None, "cpu", 3)
    assert (found.env, found.learning) == (saved.env, saved.learning)
    assert settings_of(f"--resume {tmp_path}") == saved


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("--planer.horizon 3", "did you mean '--planner.horizon'?"),
        ("--domian walker", "did you mean '--domain'?"),
        ("--domain walkr", "unknown domain 'walkr'; did you mean 'walker'?"),
        ("--domain walker --task fly --print-config", "unknown task of walker 'fly'; available: run, stand, walk"),
        ("--domain=", "unknown domain ''; available: acrobot, "),
        ("--preset gpuu", "did you mean 'gpu'?"),
        ("--planner.num_elites 999", "planner.num_elites (999)"),
        ("--frames many", "--frames must be a whole number or null, got 'many'"),
        ("--frames -1", "run.frames must be above 0, got -1"),
        ("--minutes nan", "--minutes must be a finite number or null, got 'nan'"),
        ("--device cuba", "--device must be one of auto, cpu, cuda, got 'cuba'; did you mean 'cuda'?"),
        ("--env.render_quality fats", "--env.render_quality must be one of exact, fast, fastest, got 'fats'"),
        ("--collection.noise_share 0.5", "--collection.noise_share no longer exists: every round is collected with"),
        ("--config missing.yaml", "cannot read missing.yaml"),
        ("--resume nowhere", "nothing to resume in nowhere"),
        (
            "--resume nowhere --seed 3",
            "--seed cannot be given with --resume; only --frames, --minutes, --updates, --device, --env-id, "
            "--run.devices, --run.nodes, --run.strategy, --run.ray-address can",
        ),
        ("--resume nowhere --preset auto", "--preset cannot be given with --resume"),
    ],
)
def test_train_refuses_bad_flags_in_one_line(line, expected, assert_refused, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert_refused(["train", *line.split()], expected)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("env: {domain: walkr}", "did you mean 'walker'?"),
        ("env: {domain: walker, task: 3}", "unknown task of walker 3; available: run, stand, walk"),
        ("env: {domain: [1]}", "unknown domain [1]; available:"),
        ("planner: {horizn: 3}", "unknown setting in {path}: 'planner.horizn'; did you mean 'planner.horizon'?"),
        ("planner: {horizon: [1]}", "planner.horizon must be a whole number, got [1]"),
        ("learning: {imitation_scale: 0.1}", "learning.imitation_scale no longer exists, got 0.1: scripts/distill.py"),
        ("env: [", "not valid YAML"),
    ],
)
def test_train_refuses_bad_files_in_one_line(text, expected, assert_refused, tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text(text)
    assert_refused(["train", "--config", path], expected.replace("{path}", str(path)))


def test_resume_names_a_setting_once_when_settings_contradict_each_other(assert_refused, tmp_path):
    offline = replace(
        Config(),
        collection=CollectionConfig(enabled=False),
        replay=ReplayConfig(demonstrations=("episodes",)),
        run=RunConfig(updates=9),
    )
    save_settings(offline, tmp_path)
    with pytest.raises(UserError, match=r"^run\.frames counts"):
        resolve(read_request(Request, ["--resume", str(tmp_path), "--frames", "100"]))
    assert_refused(["train", "--resume", tmp_path, "--frames", "100"], "error: run.frames counts")


@pytest.mark.parametrize("flag", ["--frames", "--minutes", "--updates", "--run.ray-address"])
def test_resume_refuses_null_which_would_keep_the_saved_value(flag, assert_refused, tmp_path):
    save_settings(Config(), tmp_path)
    assert_refused(["train", "--resume", tmp_path, flag, "null"], f"{flag} cannot be null with --resume: leave it out")
    assert_refused(["train", "--resume", tmp_path, flag, "null", "--print-config"], "cannot be null")


def test_resume_refuses_bad_changes(assert_refused, tmp_path):
    save_settings(Config(), tmp_path)
    assert_refused(["train", "--resume", tmp_path, "--frames", "0"], "run.frames must be above 0, got 0")


def test_preset_of_the_cpu_is_taken_where_torch_cannot_use_the_card(monkeypatch, capsys):
    monkeypatch.setattr("latentplan.config.files.has_cuda", lambda: True)
    monkeypatch.setattr(train, "has_cuda", lambda: True)
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    for flags, preset, is_said in (
        ([], "cpu", True),
        (["--preset", "gpu"], "gpu", False),
        (["--device", "cpu"], "cpu", False),
    ):
        request = read_request(Request, flags)
        config = train._without_cuda(request, resolve(request))
        assert config.learning == compose({}, {}, preset).learning
        assert ("those of the CPU" in capsys.readouterr().out) == is_said
