"""The folder of a run is locked by one process at a time, and refused where it cannot be made."""

import multiprocessing
from pathlib import Path

import pytest

from latentplan.config import UserError
from latentplan.config.run_folder import lock_folder
from latentplan.training.checks import check_folder


def test_lock_folder_refuses_a_second_lock_until_the_first_is_released(tmp_path):
    folder = tmp_path / "deep" / "run"
    with lock_folder(folder), pytest.raises(UserError, match="another process learns in .*run"), lock_folder(folder):
        pass
    with lock_folder(folder):  # the lock was released
        pass


def test_lock_folder_is_released_when_its_process_is_killed(tmp_path):
    context = multiprocessing.get_context("fork")  # the child imports nothing and starts no thread
    held = context.Event()
    process = context.Process(target=_hold, args=(tmp_path, held))
    process.start()
    assert held.wait(60)
    with pytest.raises(UserError), lock_folder(tmp_path):
        pass
    process.kill()
    process.join()
    with lock_folder(tmp_path):
        pass


def _hold(folder, held):
    with lock_folder(folder):
        held.set()
        multiprocessing.Event().wait()


def test_check_folder_refuses_a_folder_below_one_that_may_not_be_read(monkeypatch):
    def refuse(path):
        raise PermissionError(13, "Permission denied", str(path))

    monkeypatch.setattr(Path, "exists", refuse)
    with pytest.raises(UserError, match=r"cannot make the folder .*Permission denied: .*choose another --run-dir"):
        check_folder("private/run")


@pytest.mark.parametrize("name", ["~/runs/mine", "~"])
def test_check_folder_refuses_a_tilde_that_nobody_has_expanded(name):
    with pytest.raises(UserError, match=r"--run-dir '~.*' would be a folder named '~' here"):
        check_folder(name)
