"""The folder of a run: the settings with which the run resumes, and the lock of the folder."""

import os
from dataclasses import replace

import pytest

from latentplan.config import Config, EnvConfig, UserError, from_dict, to_dict
from latentplan.config.earlier import ADDED
from latentplan.config.files import dump_config, to_yaml
from latentplan.config.run_folder import RUN_FILE, lock_folder, read_run_config, run_saves

CONFIG = Config(env=EnvConfig(domain="cartpole", task="swingup"))


@pytest.fixture
def folder(tmp_path):
    def write(part):
        dump_config(CONFIG, part / RUN_FILE)
        return {}

    run_saves(tmp_path).commit(write, {"env_frames": 10})
    dump_config(CONFIG, tmp_path / RUN_FILE)
    return tmp_path


def test_read_run_config_returns_the_settings_without_a_warning(folder):
    assert read_run_config(folder) == (CONFIG, None)


def test_read_run_config_goes_on_with_edited_settings_and_names_the_change(folder):
    edited = replace(CONFIG, planner=replace(CONFIG.planner, horizon=9))
    dump_config(edited, folder / RUN_FILE)
    config, warning = read_run_config(folder)
    assert config == edited and f"planner.horizon from {CONFIG.planner.horizon} to 9" in warning


def test_read_run_config_keeps_what_was_edited_in_a_run_of_an_earlier_version(tmp_path):
    saved = to_dict(CONFIG)
    saved = {
        section: {name: value for name, value in fields.items() if name not in ADDED.get(section, {})}
        for section, fields in saved.items()
    }

    def write(part):
        (part / RUN_FILE).write_text(to_yaml(saved))
        return {}

    run_saves(tmp_path).commit(write, {"env_frames": 10})
    saved["planner"]["horizon"] = 9
    (tmp_path / RUN_FILE).write_text(to_yaml(saved))
    config, warning = read_run_config(tmp_path)
    assert config == from_dict(saved) and config.planner.horizon == 9
    assert warning.endswith(f"with a change of planner.horizon from {CONFIG.planner.horizon} to 9")


@pytest.mark.parametrize("content", [b"", b"env: [", b"\xff\xfe", b"planer: {}", None])
def test_read_run_config_takes_the_saved_settings_where_the_file_is_damaged(folder, content):
    (folder / RUN_FILE).unlink()
    if content is not None:
        (folder / RUN_FILE).write_bytes(content)
    config, warning = read_run_config(folder)
    assert config == CONFIG and "the settings of the last save take its place" in warning and "\n" not in warning


@pytest.mark.parametrize("share", [0.2, 0.5, 0.8, 0.99])
def test_read_run_config_never_fills_a_file_that_was_cut_off_with_defaults(folder, share):
    own = replace(CONFIG, run=replace(CONFIG.run, seed=7, frames=123))
    dump_config(own, folder / RUN_FILE)
    content = (folder / RUN_FILE).read_bytes()
    (folder / RUN_FILE).write_bytes(content[: int(share * len(content))])
    config, warning = read_run_config(folder)
    assert config == CONFIG and warning is not None


def test_read_run_config_warns_of_every_flipped_bit(folder):
    content = (folder / RUN_FILE).read_bytes()
    for place in range(0, len(content), 37):
        changed = bytearray(content)
        changed[place] ^= 1 << place % 8
        (folder / RUN_FILE).write_bytes(changed)
        assert read_run_config(folder)[1] is not None, place


def test_read_run_config_refuses_a_folder_without_a_save(folder, tmp_path):
    with pytest.raises(UserError, match="holds no save"):
        read_run_config(tmp_path / "nothing")


def test_run_saves_refuses_a_run_of_the_format_before(tmp_path):
    (tmp_path / "resume").mkdir()
    (tmp_path / "resume" / "state.pt").touch()
    with pytest.raises(UserError, match="finish it with that version, or start a new run") as caught:
        run_saves(tmp_path)
    assert "\n" not in str(caught.value)


def test_read_run_config_does_not_wait_for_a_pipe(folder):
    (folder / RUN_FILE).unlink()
    os.mkfifo(folder / RUN_FILE)
    config, warning = read_run_config(folder)
    assert config == CONFIG and "the settings of the last save take its place" in warning


@pytest.mark.parametrize("name", ["resume", "resume/logs", "checkpoints", "checkpoints/last", "videos", ".lock"])
def test_lock_folder_refuses_a_run_whose_files_would_be_written_elsewhere(tmp_path, name):
    target, path = tmp_path / "elsewhere", tmp_path / "run" / name
    target.mkdir()
    path.parent.mkdir(parents=True)
    path.symlink_to(target / "new" if name == ".lock" else target)
    with pytest.raises(UserError, match=str(path.parent)) as caught, lock_folder(tmp_path / "run"):
        pass
    assert "\n" not in str(caught.value) and list(target.iterdir()) == []
