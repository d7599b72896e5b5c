"""Several processes share each batch: they learn as one process does, and agree on everything that they decide."""

import json
import math
import os
import platform
import socket
import subprocess
import sys

import pytest

from latentplan.config import Config, LearningConfig, ReplayConfig, RunConfig, UserError
from latentplan.training.checks import check_machines
from latentplan.training.learner.registry import BEHAVIOUR_LOSSES, WORLD_MODEL_LOSSES
from latentplan.training.ranks import place_ranks
from tests.training.ranks.joined import LANES, SPOILT

UPDATES = 50
TOLERANCE = 1e-5  # sums over two halves of a batch round differently


# Compiled functions without bfloat16 products, whose rounding is coarser than what the test looks for.
COMPILER = "cc -mno-avx512bf16 -mno-amx-bf16" if platform.machine() in ("x86_64", "AMD64") else "cc"


def free_port():
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        return listener.getsockname()[1]


@pytest.fixture(scope="module")
def found(root, tmp_path_factory):
    """What two processes found, which the variables of torch.distributed made ranks, and then one process alone."""
    own = {"PYTHONPATH": str(root), "OMP_NUM_THREADS": "1", "CC": COMPILER}
    address = {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(free_port()), "WORLD_SIZE": str(LANES)}
    joined = [address | {"RANK": str(rank)} for rank in range(LANES)]
    folder, processes = tmp_path_factory.mktemp("joined"), []
    for index, variables in enumerate([*joined, {}]):
        command = [sys.executable, "-m", "tests.training.ranks.joined", str(UPDATES), str(folder / str(index))]
        processes.append(subprocess.Popen(command, cwd=root, env=os.environ | own | variables))
    try:
        assert [process.wait(timeout=500) for process in processes] == [0] * len(processes)
    finally:
        for process in processes:
            process.kill()
    return [json.loads((folder / str(index)).read_text()) for index in range(len(processes))]


@pytest.fixture
def joined(found):
    return found[:LANES]


@pytest.fixture
def single(found):
    return found[LANES]


@pytest.mark.parametrize("kind", ["plain", "fast"])
def test_losses_of_a_batch_that_two_ranks_share_equal_those_of_one_process(joined, single, kind):
    assert [each["size"] for each in (*joined, single)] == [LANES] * LANES + [1]
    assert {each["factors"] for each in (*joined, single)} <= {"torch.float32", "torch"}  # torch without a compiler
    names = [name for name, loss in (WORLD_MODEL_LOSSES | BEHAVIOUR_LOSSES).items() if loss.is_recorded]
    for update, (own, expected) in enumerate(zip(joined[0][kind]["losses"], single[kind]["losses"], strict=True)):
        for name in names:
            assert own[name] == pytest.approx(expected[name], rel=TOLERANCE, abs=TOLERANCE, nan_ok=True), (update, name)
    assert expected["continue"] > 0.0 and expected["probe"] > 0.0


@pytest.mark.parametrize("kind", ["plain", "fast"])
def test_ranks_hold_the_same_weights_averages_targets_and_counts(joined, kind):
    assert joined[0][kind]["state"] == joined[1][kind]["state"]
    assert json.dumps(joined[0][kind]["losses"]) == json.dumps(joined[1][kind]["losses"])


def test_all_ranks_skip_a_step_that_is_not_finite_on_one(joined, single):
    for each in (*joined, single):
        assert math.isnan(each["plain"]["losses"][SPOILT]["model_grad_norm"])
        totals = [value for name, value in each["plain"]["state"].items() if name.endswith("total")]
        assert totals == [1.0, 1.0]


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"learning": LearningConfig(batch_size=15)}, r"learning.batch_size \(15\) must be a multiple of 2"),
        (
            {"learning": LearningConfig(imagination_starts=9)},
            r"learning.imagination_starts \(9\) must be a multiple of 2",
        ),
        (
            {"learning": LearningConfig(cuda_graph=True), "replay": ReplayConfig(on_device=True)},
            "set learning.cuda_graph false",
        ),
    ],
)
def test_config_refuses_what_two_processes_cannot_share(settings, message):
    with pytest.raises(UserError, match=message):
        Config(run=RunConfig(devices=2), **settings)


@pytest.mark.parametrize("value", [{"devices": 0}, {"nodes": 0}, {"strategy": "fsdp"}])
def test_config_refuses_wrong_numbers_of_processes_and_other_strategies(value):
    with pytest.raises(ValueError, match=f"^{next(iter(value))} must"):
        RunConfig(**value)


def test_several_machines_need_an_address(monkeypatch):
    for name in ("MASTER_ADDR", "NODE_RANK", "SLURM_JOB_ID", "RANK", "WORLD_SIZE"):
        monkeypatch.delenv(name, raising=False)
    with pytest.raises(UserError, match=r"run\.nodes 2 needs MASTER_ADDR, MASTER_PORT and NODE_RANK"):
        check_machines(RunConfig(nodes=2, device="cpu"))


def test_processes_of_torchrun_decide_the_numbers(monkeypatch):
    assert place_ranks(Config()) == Config()
    for name, value in {"RANK": "3", "WORLD_SIZE": "4", "LOCAL_WORLD_SIZE": "2"}.items():
        monkeypatch.setenv(name, value)
    run = place_ranks(Config(run=RunConfig(devices=8))).run
    assert (run.devices, run.nodes, run.num_ranks) == (2, 2, 4)
    with pytest.raises(UserError, match="must be a multiple of 4"):
        place_ranks(Config(learning=LearningConfig(batch_size=6)))
    monkeypatch.setenv("WORLD_SIZE", "many")
    with pytest.raises(UserError, match="WORLD_SIZE must be a number above 0, got 'many'"):
        place_ranks(Config())
