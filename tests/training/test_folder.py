"""Two learnings never share a folder."""

import multiprocessing

import pytest

from latentplan.config import UserError
from latentplan.training.folder import claim


def test_a_folder_is_claimed_once(tmp_path):
    folder = tmp_path / "deep" / "run"
    with claim(folder), pytest.raises(UserError, match="another process learns in .*run"), claim(folder):
        pass
    with claim(folder):  # let go
        pass


def test_a_process_that_is_killed_lets_go(tmp_path):
    held = multiprocessing.get_context("spawn").Event()
    process = multiprocessing.get_context("spawn").Process(target=_hold, args=(tmp_path, held))
    process.start()
    assert held.wait(60)
    with pytest.raises(UserError), claim(tmp_path):
        pass
    process.kill()
    process.join()
    with claim(tmp_path):
        pass


def _hold(folder, held):
    with claim(folder):
        held.set()
        multiprocessing.Event().wait()
