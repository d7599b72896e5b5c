"""Several processes share each batch: they learn as one process does, and agree on everything that they decide."""

import json
import math
import os
import platform
import socket
import subprocess
import sys

import pytest

from latentplan.commands.main import main
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


@pytest.fixture
def unset(monkeypatch):
    """No variable of a launcher is set."""
    names = "MASTER_ADDR MASTER_PORT NODE_RANK SLURM_JOB_ID RANK WORLD_SIZE LOCAL_RANK LOCAL_WORLD_SIZE"
    for name in names.split():
        monkeypatch.delenv(name, raising=False)


def test_several_machines_need_an_address(unset):
    with pytest.raises(UserError, match=r"run\.nodes 2 needs MASTER_ADDR, MASTER_PORT and NODE_RANK"):
        check_machines(RunConfig(nodes=2, device="cpu"))


ADDRESS = {"MASTER_ADDR": "10.0.0.1", "MASTER_PORT": "29500"}
NODES_2, SIZES = {"nodes": 2}, {"WORLD_SIZE": "4", "LOCAL_WORLD_SIZE": "2"}


@pytest.mark.parametrize(
    ("run", "variables", "message"),
    [
        (NODES_2, {"MASTER_ADDR": "10.0.0.1", "NODE_RANK": "0"}, "run.nodes 2 needs MASTER_ADDR, MASTER_PORT and NODE"),
        (NODES_2, ADDRESS | {"NODE_RANK": "2"}, r"NODE_RANK \(2\) must be below run.nodes \(2\)"),
        (NODES_2, ADDRESS | {"NODE_RANK": "-1"}, "NODE_RANK must be a whole number, at least 0, got '-1'"),
        ({"devices": 2}, {"NODE_RANK": "1"}, r"NODE_RANK \(1\) must be below run.nodes \(1\)"),
        ({}, {"RANK": "a"}, "RANK must be a whole number, at least 0, got 'a'"),
        ({}, {"LOCAL_RANK": "a"}, "LOCAL_RANK must be a whole number, at least 0, got 'a'"),
        ({}, {"RANK": "0", "WORLD_SIZE": "0"}, "WORLD_SIZE must be a number above 0, got '0'"),
        ({}, {"RANK": "5", "WORLD_SIZE": "2"}, r"RANK \(5\) must be below WORLD_SIZE \(2\)"),
        ({}, SIZES | ADDRESS | {"RANK": "3", "LOCAL_RANK": "2"}, r"LOCAL_RANK \(2\) must be below LOCAL_WORLD_SIZE"),
        ({}, SIZES | {"RANK": "3", "MASTER_PORT": "1"}, "run.nodes 2 needs MASTER_ADDR and MASTER_PORT in the"),
    ],
)
def test_wrong_variables_of_a_launcher_are_refused(unset, monkeypatch, run, variables, message):
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    with pytest.raises(UserError, match=message):
        check_machines(RunConfig(device="cpu", **run))


@pytest.mark.parametrize(
    ("run", "variables"),
    [
        ({}, {"NODE_RANK": "7"}),  # of one process alone
        ({"devices": 2}, {"LOCAL_RANK": "1", "NODE_RANK": "0", "WORLD_SIZE": "2"}),  # as Lightning sets them
        (NODES_2, ADDRESS | {"NODE_RANK": "1"}),
        (NODES_2, {"SLURM_JOB_ID": "1"}),
        ({}, {"RANK": "1", "WORLD_SIZE": "2"}),
        ({}, SIZES | ADDRESS | {"RANK": "3", "LOCAL_RANK": "1"}),
    ],
)
def test_variables_of_a_launcher_are_accepted(unset, monkeypatch, run, variables):
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    check_machines(RunConfig(device="cpu", **run))


def test_train_refuses_a_wrong_rank_before_lightning_reads_it(unset, monkeypatch, tmp_path, capsys):
    monkeypatch.setenv("RANK", "a")
    monkeypatch.setenv("WORLD_SIZE", "2")
    assert main(["train", "--frames", "10", "--device", "cpu", "--run-dir", str(tmp_path / "run")]) == 2
    assert capsys.readouterr().err.startswith("error: the environment variable RANK must be a whole number")
    assert not (tmp_path / "run").exists()


def test_processes_of_torchrun_decide_the_numbers(unset, monkeypatch):
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
