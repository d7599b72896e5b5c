"""The files of a checkpoint: whole wherever writing is killed, and every changed bit is noticed."""

import json
import os
import random
import shutil
import signal
from pathlib import Path

import pytest

from latentplan.agents import files
from latentplan.agents.checkpoint import load_model, read_info, save_checkpoint, seal_checkpoint
from latentplan.agents.files import read_files, write_files
from latentplan.config import UserError
from tests.agents.small_agents import make_plain_model
from tests.agents.test_checkpoint import CONFIG, INFO, assert_refused, unseal

NAMES = ("first", "second")


def in_child(work):
    child = os.fork()
    if child == 0:
        try:
            work()
            os._exit(0)
        except BaseException:
            os._exit(1)
    return os.waitpid(child, 0)[1] == 0


def die_at(call):
    """Kills this process at a call of fsync or at a renaming, counted from 0."""
    calls = iter(range(10**6))

    def counted(function):
        def run(*arguments):
            if next(calls) == call:
                os.kill(os.getpid(), signal.SIGKILL)
            return function(*arguments)

        return run

    os.fsync, Path.replace, Path.write_bytes = map(counted, (os.fsync, Path.replace, Path.write_bytes))


@pytest.mark.parametrize("has_old", [True, False])
def test_read_files_finds_one_whole_pair_wherever_writing_is_killed(tmp_path, has_old):
    old, new, third = ({name: f"{name} {age}".encode() for name in NAMES} for age in ("old", "new", "third"))

    def write():
        die_at(call)
        write_files(folder, new)

    for call in range(100):
        folder = tmp_path / str(call)
        if has_old:
            write_files(folder, old)
        is_finished = in_child(write)
        if has_old or (folder / "manifest.json").exists():
            assert read_files(folder, NAMES) in (old, new), call
        for again in range(20):  # killed in the next commit too
            own = shutil.copytree(folder, tmp_path / f"{call}-{again}")

            def write_third(own=own, again=again):
                die_at(again)
                write_files(own, third)

            before = read_files(own, NAMES) if (own / "manifest.json").exists() else None
            is_last = in_child(write_third)
            if (own / "manifest.json").exists():
                assert read_files(own, NAMES) in (before, third)
            if is_last:
                break
        if is_finished:
            break
    assert is_finished and call > 5


@pytest.mark.parametrize(("has_manifest", "pauses"), [(True, 4), (False, 0)])
def test_read_files_waits_only_for_a_checkpoint_that_may_be_replaced(tmp_path, monkeypatch, has_manifest, pauses):
    slept = []
    monkeypatch.setattr("latentplan.agents.files.time.sleep", slept.append)
    with pytest.raises(UserError, match="cannot read"):
        read_files(tmp_path / "missing", NAMES)
    write_files(tmp_path, {name: b"content" for name in NAMES})
    (tmp_path / "first").unlink()
    if not has_manifest:
        (tmp_path / "manifest.json").unlink()
    with pytest.raises(UserError, match="first"):
        read_files(tmp_path, NAMES)
    assert len(slept) == pauses


def test_read_files_finds_a_file_that_is_renamed_while_it_is_read(tmp_path, monkeypatch):
    write_files(tmp_path, {name: b"content" for name in NAMES})
    (tmp_path / "first").rename(tmp_path / "first.part")
    read = Path.read_bytes

    def rename_first(path):
        if path.name == "first.part":
            path.rename(tmp_path / "first")
        return read(path)

    monkeypatch.setattr(Path, "read_bytes", rename_first)
    assert read_files(tmp_path, NAMES)["first"] == b"content"


def test_read_files_does_not_wait_for_another_format(tmp_path, monkeypatch):
    monkeypatch.setattr("latentplan.agents.files.time.sleep", pytest.fail)
    write_files(tmp_path, {name: b"content" for name in NAMES})
    monkeypatch.setattr("latentplan.agents.files.FORMAT", 2)
    with pytest.raises(UserError, match="has format 1"):
        read_files(tmp_path, NAMES)


@pytest.fixture(scope="module")
def agent(tmp_path_factory):
    folder = tmp_path_factory.mktemp("agent") / "agent"
    save_checkpoint(folder, make_plain_model(heads=("reward_head",)), CONFIG, INFO)
    return folder


def test_load_model_notices_every_flipped_bit(agent, tmp_path, monkeypatch):
    monkeypatch.setattr("latentplan.agents.files.PAUSE_SECONDS", 0.0)
    folder, rng = shutil.copytree(agent, tmp_path / "agent"), random.Random(0)
    for path in sorted(folder.iterdir()):
        content = path.read_bytes()
        for place in [0, len(content) - 1, *(rng.randrange(len(content)) for _ in range(30))]:
            changed = bytearray(content)
            changed[place] ^= 1 << rng.randrange(8)
            path.write_bytes(changed)
            with pytest.raises(UserError) as caught:
                load_model(folder)
            assert "\n" not in str(caught.value)
        path.write_bytes(content)
    load_model(folder)


@pytest.mark.parametrize("is_sealed", [True, False])
@pytest.mark.parametrize("name", ["info.json", "weights.safetensors"])
def test_files_are_read_up_to_a_size_only(agent, tmp_path, name, is_sealed, monkeypatch):
    monkeypatch.setattr("latentplan.agents.files.PAUSE_SECONDS", 0.0)
    folder = shutil.copytree(agent, tmp_path / "agent")
    if not is_sealed:
        unseal(folder)
    size = (folder / name).stat().st_size
    monkeypatch.setitem(files.LARGEST, name, size)
    load_model(folder)
    monkeypatch.setitem(files.LARGEST, name, size - 1)
    assert_refused(lambda: load_model(folder), name, f"more than {size - 1:,} bytes")


def test_files_of_a_checkpoint_are_regular_files(agent, tmp_path, monkeypatch):
    monkeypatch.setattr("latentplan.agents.files.PAUSE_SECONDS", 0.0)
    folder = tmp_path / "folder"
    folder.mkdir()
    os.mkfifo(folder / "pipe")
    assert_refused(lambda: read_files(folder, ("pipe",)), "pipe", "not a regular file")


def test_load_model_says_what_to_do_after_a_deliberate_change(agent, tmp_path):
    folder = shutil.copytree(agent, tmp_path / "agent")
    info = json.loads((folder / "info.json").read_text())
    info["config"]["planner"]["horizon"] = 2
    (folder / "info.json").write_text(json.dumps(info))
    assert_refused(lambda: read_info(folder), "info.json is damaged", "manifest.json", "delete")
    seal_checkpoint(folder)
    assert load_model(folder)[1].planner.horizon == 2
    (folder / "info.json").write_text(json.dumps(info) + " ")
    assert_refused(lambda: read_info(folder), "damaged")
    unseal(folder)
    assert load_model(folder)[1].planner.horizon == 2


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"discunt": 0.9}, ("unknown key 'discunt'", "discount")),
        ({"format": 99}, ("format", "99")),
        ({"format": True}, ("format", "True")),
        ({"discount": float("nan")}, ("discount", "nan")),
        ({"discount": 5.0}, ("discount", "5.0")),
        ({"env_frames": 10**4000}, ("env_frames", "100000")),
        ({"env_frames": 1.5}, ("env_frames", "1.5")),
        ({"action_dim": 10**9}, ("action_dim", "4096")),
        ({"goal_dim": -1}, ("goal_dim", "-1")),
        ({"labels": {"speed": 0.0}}, ("labels", "above 0")),
        ({"labels": {"speed": float("inf")}}, ("labels", "inf")),
        ({"sha256": "0"}, ("sha256", "64")),
        ({"minutes": -1}, ("minutes", "-1")),
    ],
)
def test_read_info_refuses_unknown_keys_and_values_out_of_range(agent, tmp_path, change, words):
    folder = shutil.copytree(agent, tmp_path / "agent")
    unseal(folder)
    path = folder / "info.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | change))
    assert len(assert_refused(lambda: read_info(folder), *words)) < 400


def test_load_model_compares_sizes_before_it_allocates_a_model(agent, tmp_path):
    folder = shutil.copytree(agent, tmp_path / "agent")
    unseal(folder)
    path = folder / "info.json"
    info = json.loads(path.read_text())
    info["config"]["model"]["deter_dim"] = 10**7  # some petabytes
    path.write_text(json.dumps(info))
    assert_refused(lambda: load_model(folder), "does not fit its own settings")
