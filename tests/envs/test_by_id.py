"""Environments of gymnasium's registry: named by id, refused in one line, and never imported from a file."""

import re
import sys
from dataclasses import replace

import numpy as np
import pytest
from gymnasium.spaces import Dict, Discrete

from latentplan.config import CollectionConfig, Config, EnvConfig, ModelConfig, RunConfig, UserError
from latentplan.config.env_id import (
    EnvChoice,
    as_file_name,
    by_id,
    choose_env,
    import_named,
    imported_modules,
    repeat_flag,
    split_id,
)
from latentplan.envs import make_env, process, wrap_user_env
from latentplan.envs.by_id import find_id
from latentplan.envs.conformance import check_environment
from latentplan.envs.vector import make_vector_env
from latentplan.training import train
from tests.envs import odd

MODULE = "tests.envs.odd"


def config_of(name, **settings):
    return EnvConfig(**by_id(f"{MODULE}:{name}-v0"), **settings)


def as_one_line(error, words):
    text = str(error)
    assert "\n" not in text and all(word in text for word in words), text


@pytest.mark.parametrize("name", odd.REFUSED)
def test_check_environment_refuses_odd_environments_in_one_line_with_a_remedy(name):
    _, settings, words = odd.REFUSED[name]
    report = check_environment(config_of(f"odd/{name}", **settings), decisions=20, isolate=False)
    assert len(report.problems) == 1
    as_one_line(report.problems[0], words)


@pytest.mark.parametrize("name", ["WrongStart", "WrongStartWithArguments"])
def test_check_environment_shows_where_the_start_of_an_environment_fails(name):
    report = check_environment(config_of(f"odd/{name}", **odd.REFUSED[name][1]), decisions=1, isolate=False)
    assert "int([size])" in report.origin and "env-kwargs" not in report.problems[0]


@pytest.mark.parametrize(("name", "has_own"), [("NoSeed", False), ("NoInfoAtAll", False), ("FailingReset", True)])
def test_traceback_is_that_of_the_environments_own_code_or_of_none(name, has_own):
    report = check_environment(config_of(f"odd/{name}"), decisions=5, isolate=False)
    places = re.findall(r'^  File "([^"]*)"', report.origin, re.MULTILINE)
    assert places == [odd.__file__] * len(places) and bool(places) == bool(report.origin) == has_own


@pytest.mark.parametrize("name", odd.REFUSED)
def test_train_refuses_odd_environments_before_it_learns(name, tmp_path):
    _, settings, words = odd.REFUSED[name]
    config = Config(
        env=config_of(f"odd/{name}", **settings),
        model=ModelConfig(
            deter_dim=8, hidden_dim=8, decoder_width=4, encoder_channels=(4, 4), decoder_channels=2, num_bins=5
        ),
        collection=CollectionConfig(overlap=False),
        run=RunConfig(frames=100, device="cpu", threads=1, run_dir=str(tmp_path / "run")),
    )
    with pytest.raises(UserError) as error:
        train(config)
    as_one_line(error.value, words)
    assert not (tmp_path / "run" / "config.yaml").exists()


@pytest.mark.parametrize("name", odd.CRASHING)
def test_check_environment_survives_crashes_and_hangs(name, monkeypatch):
    if name == "HangAtStart":
        monkeypatch.setattr(process, "START_SECONDS", 2.0)
    report = check_environment(config_of(f"odd/{name}"), decisions=5, step_timeout_s=1.0)
    assert len(report.problems) == 1
    as_one_line(report.problems[0], odd.CRASHING[name][1])


@pytest.mark.parametrize("name", odd.NOTED)
def test_check_environment_notes_what_training_accepts_and_nobody_means(name):
    report = check_environment(config_of(f"odd/{name}"), decisions=150, isolate=False)
    assert report.problems == [] and any(odd.NOTED[name][1] in note for note in report.notes), report.notes


def test_check_environment_finds_nothing_to_note_in_a_good_environment():
    report = check_environment(config_of("Slider"), decisions=120, isolate=False)
    assert (report.problems, report.notes) == ([], [])
    assert report.facts["own actions"] == "float32 (1,) in [-1, 1]" and report.facts["starts"] == "differ by seed"
    assert report.facts["episode"] == "at most 10 decisions of 2 steps"
    assert len(report.pictures) == 8 and report.pictures[0].shape == (64, 64, 3)


def test_check_environment_says_that_a_fourth_channel_is_alpha():
    for name, is_named in (("WithAlpha", True), ("Slider", False)):
        report = check_environment(config_of(name), decisions=2, isolate=False)
        assert report.problems == []
        assert ("the fourth channel of a picture is read as alpha" in report.facts["observations"]) == is_named


def test_refusal_names_both_spaces():
    report = check_environment(config_of("odd/TextActions"), decisions=1, isolate=False)
    both = odd.with_spaces(odd.STATE, odd.REFUSED["TextActions"][0].action_space)
    with pytest.raises(UserError, match=r"observation_space .*; action.*Text"):
        wrap_user_env(both())
    assert len(report.problems) == 1


def test_make_env_makes_the_environment_with_its_arguments():
    bright, dim = (
        make_env(config_of("odd/State", pixels="render", kwargs=text), seed=0) for text in ("{}", '{"brightness": 100}')
    )
    assert bright.reset()[0].max() == 255 and dim.reset()[0].max() == 100
    assert bright.decisions_per_episode == 10
    assert make_env(config_of("Slider", kwargs='{"max_episode_steps": 8}')).decisions_per_episode == 4
    own = make_env(config_of("Slider")).decisions_per_episode
    assert make_env(config_of("Slider", kwargs='{"max_episode_steps": null}')).decisions_per_episode == own


def test_rendered_pictures_are_squeezed_whole_and_drawn_once_per_decision():
    inner = odd.State(render_mode="rgb_array")
    env = wrap_user_env(inner, action_repeat=3, config=EnvConfig(pixels="render"))
    frame, _ = env.reset(seed=0)
    assert frame.shape == (64, 64, 3) and inner.num_drawn == 1
    for _ in range(20):
        right, *_ = env.step(np.ones(1))
    assert inner.num_drawn == 21
    assert right[:, -1].min() > 200 and right[:, :32].max() == 0  # nothing is cut off at the side
    assert env.render_large(128).shape == (128, 128, 3)


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ('{"disable_env_checker": false}', "--env-kwargs cannot hold 'disable_env_checker'"),
        ('{"id": "x"}', "--env-kwargs cannot hold 'id'"),
        ('{"max_episode_steps": "200"}', "max_episode_steps must be a whole number of at least 1, .*, got '200'"),
        ('{"max_episode_steps": 0}', "max_episode_steps must be a whole number of at least 1, .*, got 0"),
        ('{"max_episode_steps": true}', "max_episode_steps must be a whole number of at least 1, .*, got True"),
    ],
)
def test_arguments_of_gymnasium_that_cannot_be_passed_on_are_not_blamed_on_the_environment(kwargs, message):
    with pytest.raises(UserError, match=message) as refusal:
        make_env(config_of("Slider", kwargs=kwargs))
    assert "the environment raised" not in str(refusal.value)


class Sensed(odd.State):
    """Shows vectors, and a picture that nobody sees where pictures are drawn."""

    observation_space = Dict({"place": odd.STATE, "view": odd.PICTURE, "gear": Discrete(2)})

    def observe(self):
        return {"place": super().observe(), "view": self.draw(16, 16), "gear": 1}


def test_rendered_pictures_may_have_vectors_beside_them():
    inner = Sensed(render_mode="rgb_array")
    config = EnvConfig(pixels="render", vectors=("place",))
    env = wrap_user_env(inner, config=config)
    assert (env.spaces.cameras, env.spaces.vector_dim) == (1, 4)
    frame, info = env.reset(seed=0)
    alone = wrap_user_env(Sensed(render_mode="rgb_array"), config=EnvConfig(pixels="render")).reset(seed=0)[0]
    assert np.array_equal(frame, alone)
    assert info["vectors"].tolist() == [np.float32(inner.place)] * 4
    *_, info = env.step(np.ones(1))
    assert info["vectors"].tolist() == [np.float32(inner.place)] * 4


@pytest.mark.parametrize(
    ("kind", "settings", "message"),
    [
        (odd.State, {"vectors": ("place",)}, "'place', but observation_space is Box.*or leave env.vectors empty"),
        (Sensed, {"vectors": ("joints",)}, "'joints', which observation_space lacks; it has gear, place"),
        (Sensed, {"vectors": ("picture",)}, "env.vectors cannot name 'picture' with env.pixels render"),
        (Sensed, {"vectors": ("gear",)}, r"observation_space\['gear'\].* must be a Box of numbers"),
        (Sensed, {"cameras": ("view",)}, "env.cameras has no effect with env.pixels render.*leave env.cameras out"),
    ],
)
def test_settings_that_do_not_fit_rendered_pictures_are_refused_without_naming_render_again(kind, settings, message):
    with pytest.raises(UserError, match=message) as refusal:
        wrap_user_env(kind(render_mode="rgb_array"), config=EnvConfig(pixels="render", **settings))
    assert "--env.pixels render takes" not in str(refusal.value)


def test_vector_environments_import_the_module_in_their_processes():
    envs = make_vector_env(config_of("Slider"), num_envs=2, seed=0)
    try:
        assert envs.reset()[0].shape == (2, 64, 64, 3)
    finally:
        envs.close()


def test_module_of_a_checkpoint_is_not_imported(monkeypatch):
    config = config_of("Slider")
    assert imported_modules(config) == (MODULE,)
    monkeypatch.delitem(sys.modules, MODULE)
    with pytest.raises(UserError, match=rf"never imported .*give --env-id {MODULE}:Slider-v0"):
        make_env(config)
    assert imported_modules(config) == () and MODULE not in sys.modules
    assert repeat_flag(config) == f" --env-id {MODULE}:Slider-v0"


@pytest.mark.parametrize(
    ("env_id", "expected"),
    [
        ("Reach-v0", (None, "Reach-v0")),
        ("my_robot:Reach-v0", ("my_robot", "Reach-v0")),
        ("my.robot:arms/Reach-v0", ("my.robot", "arms/Reach-v0")),
    ],
)
def test_split_id_separates_the_module(env_id, expected):
    assert split_id(env_id) == expected


@pytest.mark.parametrize(
    "text", ["", ":", "my_robot:", "my robot:Reach-v0", "../x:Reach-v0", "a:b:c", "Reach v0", "a.:R"]
)
def test_split_id_refuses_other_texts(text):
    with pytest.raises(UserError, match="--env-id must be an id"):
        split_id(text)


def test_import_named_finds_modules_in_the_present_folder_and_explains_failures(tmp_path, monkeypatch):
    (tmp_path / "a_robot.py").write_text("LOADED = True\n")
    (tmp_path / "a_broken_robot.py").write_text("1 / 0\n")
    (tmp_path / "a_poor_robot.py").write_text("import a_library_that_nobody_has\n")
    (tmp_path / "a_cut_robot.py").write_text("def make(:\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [place for place in sys.path if place])
    import_named("a_robot:Reach-v0")
    assert sys.modules.pop("a_robot").LOADED
    for module, words in {
        "a_broken_robot": "importing a_broken_robot raised ZeroDivisionError",
        "a_poor_robot": "needs a_library_that_nobody_has, which is not installed",
        "a_cut_robot": "importing a_cut_robot raised SyntaxError",
        "a_robot.py": "name the module without .py, as in --env-id a_robot:Reach-v0",
        "no_robot": "there is no module no_robot to import",
    }.items():
        with pytest.raises(UserError, match=words) as refusal:
            import_named(f"{module}:Reach-v0")
        origin = getattr(refusal.value, "origin", "")
        assert set(re.findall(r'^  File "([^"]*)"', origin, re.MULTILINE)) <= {str(tmp_path / f"{module}.py")}


def test_choose_env_keeps_what_is_remembered():
    saved = config_of("odd/State", pixels="render", kwargs='{"brightness": 9}')
    assert choose_env(saved, {}) == saved
    assert choose_env(saved, {"id": saved.task}) == saved
    other = choose_env(saved, {"id": "Slider-v0", "pixels": "observation"})
    assert (other.task, other.kwargs, other.pixels) == ("Slider-v0", "{}", "observation")
    assert choose_env(EnvConfig(), {"id": "Slider-v0"}).suite == "gymnasium"


def test_choose_env_refuses_what_has_no_effect_or_does_not_match():
    with pytest.raises(UserError, match="--env-kwargs has no effect in walker-walk; give --env-id too"):
        choose_env(EnvConfig(task="walk"), {"kwargs": "{}"})
    with pytest.raises(UserError, match="another environment than"):
        choose_env(config_of("Slider"), {"id": "odd/State-v0"}, must_match=True)
    with pytest.raises(UserError, match="env.kwargs must be a JSON object"):
        choose_env(config_of("Slider"), {"kwargs": "[1]"})
    assert EnvChoice() == EnvChoice(None, "{}", "observation")


@pytest.mark.parametrize("text", ["", "[1]", "3", '{"a": ', "null", "{'a': 1}", "[" * 100_000])
def test_kwargs_must_be_a_json_object(text):
    with pytest.raises(ValueError, match="kwargs must be a JSON object such as"):
        EnvConfig(kwargs=text)


def test_folder_names_hold_no_separators():
    assert as_file_name("gymnasium-my_robot:arms/Reach-v0-seed0") == "gymnasium-my_robot-arms-Reach-v0-seed0"


def test_unknown_ids_are_answered_by_the_nearest():
    with pytest.raises(UserError, match="unknown environment 'Slidr-v0'; did you mean 'Slider-v0'"):
        make_env(replace(config_of("Slider"), task="Slidr-v0"))


def test_strip_of_several_cameras_shows_the_first(tmp_path):
    config = EnvConfig(domain="cartpole", task="swingup", cameras=("0", "1"))
    report = check_environment(config, decisions=3, isolate=False)
    assert report.problems == [] and {picture.shape for picture in report.pictures} == {(64, 64, 3)}


def test_usual_environment_of_the_suite_is_made_without_an_id():
    assert find_id(EnvConfig(suite="gymnasium", domain="gymnasium")) == "InvertedPendulum-v5"
