"""`benchmark.py paths`: every fast path is timed beside its reference."""

import json

import benchmark
import pytest

SIZES = {
    "model.deter_dim": 32,
    "model.hidden_dim": 32,
    "model.encoder_channels": "[4,4]",
    "model.decoder_channels": 2,
    "model.num_bins": 5,
    "learning.batch_size": 2,
    "learning.sequence_length": 4,
    "learning.imagination_horizon": 2,
    "learning.imagination_starts": 4,
}


def test_paths_times_every_fast_path_beside_its_reference(tmp_path, capsys):
    path = tmp_path / "paths.json"
    sizes = [word for name, value in SIZES.items() for word in (f"--{name}", str(value))]
    flags = ["--samples", "6", "--horizon", "2", "--repeats", "2", "--action-dim", "2", "--device", "cpu"]
    assert benchmark.main(["paths", *flags, *sizes, "--json", str(path)]) == 0
    rows = {row["path"]: row for row in json.loads(path.read_text())["paths"]}
    printed = capsys.readouterr().out
    for name in ("rollout of 6, compiled kernels", "rollout of 6, converted weights", "one frame"):
        assert name in rows
    assert sum("with gradients" in name for name in rows) == 6
    for name, row in rows.items():
        assert name in printed and row["fast_ms"] > 0.0
        assert row["ratio"] == pytest.approx(row["reference_ms"] / row["fast_ms"])
