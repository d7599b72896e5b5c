"""`benchmark.py saving`: its rows are those that it names, and an update without guards is still an update."""

import json

import benchmark
import pytest
from bench.saving import Request, time_saves

from latentplan.config.commit import Saves
from latentplan.replay.disk import count_saved


def test_saving_measures_saves_and_guards(config, monkeypatch, tmp_path):
    monkeypatch.setattr(Request, "compose", lambda *_: config)
    path = tmp_path / "result.json"
    flags = ["--rows", "60", "--new-rows", "10", "--saves", "1", "--blocks", "1", "--device", "cpu"]
    assert benchmark.main(["saving", *flags, "--json", str(path)]) == 0
    result = json.loads(path.read_text())
    assert len(result["wall_s"]) == 2 and result["with_ms"] > 0.0 and result["without_ms"] > 0.0


@pytest.mark.parametrize("rows", [60, 500, 720])
def test_first_save_holds_the_rows_that_were_asked_for(config, tmp_path, rows):
    time_saves(config, Request(rows=rows, new_rows=10, saves=1), tmp_path)
    saves = Saves(tmp_path, "run", 1)
    held = [count_saved(saves.verify(folder)).lane_rows for folder in sorted(tmp_path.glob("save-*"))]
    assert held == [rows, rows + 10]
