"""The files of a checkpoint: whole wherever writing is killed, and every changed bit is noticed."""

import hashlib
import json
import math
import os
import random
import shutil
from pathlib import Path

import pytest

from latentplan.agents import files
from latentplan.agents.checkpoint import load_model, read_info, resolve_checkpoint, save_checkpoint, seal_checkpoint
from latentplan.agents.files import read_files, remove_leftovers, write_files
from latentplan.config import UserError
from tests.agents.small_agents import make_plain_model
from tests.agents.test_checkpoint import CONFIG, INFO, assert_refused, unseal
from tests.killing import die_at, in_child

NAMES = ("first", "second")
CALLS = ((os, "fsync"), (Path, "replace"), (Path, "write_bytes"))


@pytest.mark.parametrize("has_old", [True, False])
def test_read_files_finds_one_whole_pair_wherever_writing_is_killed(tmp_path, has_old):
    old, new, third = ({name: f"{name} {age}".encode() for name in NAMES} for age in ("old", "new", "third"))

    def write():
        die_at(call, *CALLS)
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
                die_at(again, *CALLS)
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


def test_write_files_replaces_links_beside_the_files(tmp_path):
    folder, other = tmp_path / "agent", tmp_path / "other"
    folder.mkdir()
    other.write_text("kept")
    for name in (*NAMES, "manifest.json"):
        (folder / f"{name}.part").symlink_to(other)
    write_files(folder, {name: name.encode() for name in NAMES})
    assert other.read_text() == "kept" and read_files(folder, NAMES) == {name: name.encode() for name in NAMES}
    assert not any(path.is_symlink() for path in folder.iterdir())


@pytest.mark.parametrize("call", range(4))
@pytest.mark.parametrize("has_old", [True, False])
def test_write_files_that_fails_leaves_nothing(tmp_path, monkeypatch, call, has_old):
    old, calls = {name: b"old" for name in NAMES}, iter(range(100))
    if has_old:
        write_files(tmp_path, old)
    before = sorted(tmp_path.iterdir())

    def fill_up(descriptor):
        if next(calls) == call:
            raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", fill_up)
    with pytest.raises(OSError, match="No space left"):
        write_files(tmp_path, {name: b"new" for name in NAMES})
    assert sorted(tmp_path.iterdir()) == before
    assert not has_old or read_files(tmp_path, NAMES) == old


@pytest.mark.parametrize("has_old", [True, False])
def test_remove_leftovers_keeps_one_whole_checkpoint_wherever_writing_is_killed(tmp_path, has_old):
    old, new = ({name: f"{name} {age}".encode() for name in NAMES} for age in ("old", "new"))

    def write():
        die_at(call, *CALLS)
        write_files(folder, new)

    for call in range(100):
        folder = tmp_path / str(call)
        if has_old:
            write_files(folder, old)
        is_finished = in_child(write)
        before = read_files(folder, NAMES) if (folder / "manifest.json").exists() else None
        remove_leftovers(folder, NAMES)
        assert {path.name for path in folder.glob("*")} == ({*NAMES, "manifest.json"} if before else set())
        assert before is None or read_files(folder, NAMES) == before
        if is_finished:
            break
    assert is_finished and call > 5


def test_remove_leftovers_leaves_a_checkpoint_whose_manifest_is_damaged(agent, tmp_path):
    folder = shutil.copytree(agent, tmp_path / "agent")
    (folder / "info.json").rename(folder / "info.json.part")
    (folder / "manifest.json").write_text("{")
    before = sorted(folder.iterdir())
    remove_leftovers(folder, ("info.json", "weights.safetensors"))
    assert sorted(folder.iterdir()) == before


def test_load_model_takes_the_last_agent_where_the_best_one_was_never_committed(agent, tmp_path):
    shutil.copytree(agent, tmp_path / "checkpoints" / "last")
    best = shutil.copytree(agent, tmp_path / "checkpoints" / "best")
    (best / "manifest.json").unlink()
    for path in list(best.iterdir()):
        path.rename(f"{path}.part")
    assert resolve_checkpoint(tmp_path) == tmp_path / "checkpoints" / "last"
    load_model(tmp_path)


def test_seal_checkpoint_that_refuses_an_agent_leaves_its_manifest(agent, tmp_path):
    folder = shutil.copytree(agent, tmp_path / "agent")
    before = (folder / "manifest.json").read_bytes()
    info = json.loads((folder / "info.json").read_text())
    (folder / "info.json").write_text(json.dumps(info | {"discount": 5}))
    assert_refused(lambda: seal_checkpoint(folder), "discount")
    assert (folder / "manifest.json").read_bytes() == before


def test_seal_checkpoint_finishes_a_commit_that_was_cut_off(agent, tmp_path):
    folder = shutil.copytree(agent, tmp_path / "agent")
    for name in ("info.json", "weights.safetensors"):
        (folder / name).rename(folder / f"{name}.part")
        (folder / name).write_bytes(b"old")
    seal_checkpoint(folder)
    load_model(folder)
    assert sorted(path.name for path in folder.iterdir()) == ["info.json", "manifest.json", "weights.safetensors"]


@pytest.mark.parametrize("dtype", ["F16", "BF16", "F32", "F64", "BOOL", "U8", "I64", "C64", "F8_E8M0", "F8_E5M2"])
def test_load_model_accepts_floating_point_weights_only(agent, tmp_path, dtype):
    folder = shutil.copytree(agent, tmp_path / "agent")
    unseal(folder)
    sizes = {"F64": 8, "C64": 8, "I64": 8, "F32": 4, "F16": 2, "BF16": 2}
    content = (folder / "weights.safetensors").read_bytes()
    length = int.from_bytes(content[:8], "little")
    header, place = {}, 0
    for name, entry in json.loads(content[8 : 8 + length]).items():
        end = place + math.prod(entry["shape"]) * sizes.get(dtype, 1)
        header[name], place = {"dtype": dtype, "shape": entry["shape"], "data_offsets": [place, end]}, end
    text = json.dumps(header).encode()
    content = len(text).to_bytes(8, "little") + text + bytes(place)
    (folder / "weights.safetensors").write_bytes(content)
    info = json.loads((folder / "info.json").read_text())
    (folder / "info.json").write_text(json.dumps(info | {"sha256": hashlib.sha256(content).hexdigest()}))
    if dtype in ("F16", "BF16", "F32", "F64"):
        load_model(folder)
    else:
        assert_refused(lambda: load_model(folder), f"has dtype {dtype}", "F16, BF16, F32, F64")
