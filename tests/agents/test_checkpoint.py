"""Checkpoints: the same agent comes back, or the user hears in one line why not."""

import copy
import hashlib
import json

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file

from latentplan.agents.checkpoint import load_agent, load_model, read_info, resolve_checkpoint, save_checkpoint
from latentplan.agents.planning import PlanningAgent
from latentplan.config import Config, EnvConfig, ModelConfig, PlannerConfig, UserError
from latentplan.models import WorldModel
from latentplan.models.fast import accelerate

CONFIG = Config(
    env=EnvConfig(domain="cartpole", task="swingup"),
    model=ModelConfig(deter_dim=16, hidden_dim=16, encoder_channels=(8, 8), decoder_channels=2, num_bins=15),
    planner=PlannerConfig(horizon=3, num_samples=16, num_elites=4, num_iterations=2, num_policy_samples=2),
)
INFO = {"domain": "cartpole", "task": "swingup", "env_frames": 1000, "discount": 0.9, "metrics": [{"planner": 1.5}]}
FRAMES = np.random.default_rng(0).integers(0, 256, (4, 64, 64, 3), dtype=np.uint8)


@pytest.fixture(scope="module")
def model():
    torch.manual_seed(0)
    model = accelerate(WorldModel(CONFIG.model, action_dim=2))
    with torch.no_grad():
        model.reward_head.mlp.output.weight.normal_(std=0.3)
        # A checkpoint holds float16: weights that are float16 already come back exactly.
        for parameter in model.parameters():
            parameter.copy_(parameter.half().float())
    return model


@pytest.fixture
def folder(model, tmp_path):
    save_checkpoint(tmp_path / "agent", model, CONFIG, INFO)
    return tmp_path / "agent"


def assert_refused(call, *words):
    with pytest.raises(UserError) as caught:
        call()
    message = str(caught.value)
    assert "\n" not in message
    assert all(word in message for word in words), message
    return message


def change_info(folder, **changes):
    path = folder / "info.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))


def history(agent):
    agent.seed(0)
    return np.stack([agent.act(frame) for frame in FRAMES])


def test_weights_and_settings_come_back(model, folder):
    loaded, config, info = load_model(folder)
    assert config == CONFIG
    assert info.items() >= INFO.items()
    assert all(torch.equal(value, loaded.state_dict()[name]) for name, value in model.state_dict().items())


@pytest.mark.parametrize("mode", ["planner", "gated", "actor", "random"])
def test_an_agent_acts_the_same_each_time_it_is_loaded(folder, mode):
    first, second = history(load_agent(folder, mode)), history(load_agent(folder, mode))
    assert first.shape == (4, 2)
    assert np.array_equal(first, second)


def test_an_agent_acts_as_before_it_was_saved(model, folder):
    before = PlanningAgent(model, CONFIG, 0.9)
    assert np.array_equal(history(before), history(load_agent(folder)))
    assert load_agent(folder).encode(FRAMES[0]).shape == (32,)


def test_saving_twice_replaces_the_first(model, folder):
    save_checkpoint(folder, model, CONFIG, INFO | {"env_frames": 2000})
    assert read_info(folder)["env_frames"] == 2000
    assert sorted(path.name for path in folder.iterdir()) == ["info.json", "weights.safetensors"]
    load_model(folder)


def test_whoever_may_read_the_description_may_read_the_weights(folder):
    assert len({oct(path.stat().st_mode) for path in folder.iterdir()}) == 1
    assert (folder / "info.json").read_text().endswith("}\n")


def test_a_run_folder_means_its_best_agent_or_else_its_last(model, tmp_path):
    save_checkpoint(tmp_path / "checkpoints" / "last", model, CONFIG, INFO | {"env_frames": 2})
    assert read_info(tmp_path)["env_frames"] == 2
    save_checkpoint(tmp_path / "checkpoints" / "best", model, CONFIG, INFO | {"env_frames": 1})
    assert read_info(str(tmp_path))["env_frames"] == 1


def test_a_checkpoint_of_the_default_sizes_is_small(tmp_path):
    config = Config()
    save_checkpoint(tmp_path, WorldModel(config.model, action_dim=6), config, INFO)
    assert sum(path.stat().st_size for path in tmp_path.iterdir()) <= 2.5e6


@pytest.mark.parametrize("place", [0.1, 0.5, 0.999])
def test_a_changed_byte_is_noticed(folder, place):
    path = folder / "weights.safetensors"
    content = bytearray(path.read_bytes())
    content[int(place * len(content))] ^= 1
    path.write_bytes(content)
    assert_refused(lambda: load_agent(folder), "damaged", "weights.safetensors")


def test_a_cut_off_file_is_noticed(folder):
    path = folder / "weights.safetensors"
    path.write_bytes(path.read_bytes()[:-100])
    assert_refused(lambda: load_agent(folder), "damaged")


@pytest.mark.parametrize("content", ["{}", "[1, 2]", "nonsense", '{"config": {}}'])
def test_foreign_folders_are_refused(folder, content):
    (folder / "info.json").write_text(content)
    assert_refused(lambda: read_info(folder), "info.json")


@pytest.mark.parametrize("key", ["domain", "task", "env_frames", "discount", "action_dim", "config", "sha256"])
def test_a_missing_fact_is_named(folder, key):
    facts = json.loads((folder / "info.json").read_text())
    del facts[key]
    (folder / "info.json").write_text(json.dumps(facts))
    assert_refused(lambda: read_info(folder), f"lacks {key}")


@pytest.mark.parametrize(
    ("config", "word"),
    [
        ({"planner": {"horizn": 3}}, "planner.horizn"),
        ({"planner": {"horizon": 0}}, "horizon"),
        ({"planner": {"horizon": "far"}}, "settings"),
        ({"planer": {}}, "planer"),
        ({"planner": 3}, "settings"),
        (3, "settings"),
    ],
)
def test_settings_that_cannot_be_used_are_named(folder, config, word):
    change_info(folder, config=config)
    assert_refused(lambda: load_agent(folder), "info.json", word)


@pytest.mark.parametrize(
    ("key", "value"),
    [("env_frames", None), ("action_dim", "two"), ("discount", "high"), ("labels", [1]), ("sha256", 3)],
)
def test_facts_of_another_kind_are_refused(folder, key, value):
    change_info(folder, **{key: value})
    assert_refused(lambda: load_agent(folder), "info.json", key)


@pytest.mark.parametrize("action_dim", [-1, 0])
def test_sizes_that_cannot_be_are_refused(folder, action_dim):
    change_info(folder, action_dim=action_dim)
    assert_refused(lambda: load_agent(folder), "does not fit")


@pytest.mark.parametrize("number", ["nan", "inf"])
def test_weights_that_are_not_finite_are_refused(folder, number):
    path = folder / "weights.safetensors"
    weights = load_file(path)
    weights["reward_head.mlp.output.bias"][0] = float(number)
    save_file(weights, path)
    change_info(folder, sha256=hashlib.sha256(path.read_bytes()).hexdigest())
    assert_refused(lambda: load_agent(folder), "reward_head.mlp.output.bias", "not finite")


def test_what_float16_cannot_hold_is_not_saved(model, folder):
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    large = copy.deepcopy(model)
    with torch.no_grad():
        large.actor.mlp.output.weight[0, 0] = 1e5
    with pytest.raises(FloatingPointError, match=r"actor\.mlp\.output\.weight"):
        save_checkpoint(folder, large, CONFIG, INFO)
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before


@pytest.mark.parametrize("mode", ["actor", "random"])
def test_settings_of_a_search_are_refused_where_nothing_is_searched(folder, mode):
    assert_refused(lambda: load_agent(folder, mode=mode, horizon=3), "horizon has no effect", mode)


def test_weights_of_other_sizes_are_refused(folder):
    change_info(folder, action_dim=3)
    assert_refused(lambda: load_agent(folder), "does not fit")


def test_missing_folders_are_refused(tmp_path):
    assert_refused(lambda: load_agent(tmp_path / "nothing"), "does not exist")
    assert_refused(lambda: load_agent(tmp_path), "expected weights.safetensors and info.json")


def test_a_near_miss_is_named(folder, model, tmp_path):
    save_checkpoint(tmp_path / "walker-run" / "checkpoints" / "last", model, CONFIG, INFO)
    message = assert_refused(lambda: resolve_checkpoint(tmp_path / "wlker-run"), "did you mean")
    assert message.endswith(f"{tmp_path / 'walker-run'}?")
    message = assert_refused(lambda: resolve_checkpoint(tmp_path / "xyz"), "available: ")
    assert str(folder) in message and str(tmp_path / "walker-run") in message


def test_shipped_checkpoints_are_suggested(model, tmp_path, monkeypatch):
    save_checkpoint(tmp_path / "checkpoints" / "walker", model, CONFIG, INFO)
    monkeypatch.chdir(tmp_path)
    assert_refused(lambda: resolve_checkpoint("elsewhere/walkr"), "did you mean checkpoints/walker?")


def test_what_cannot_be_chosen_is_named(folder):
    assert_refused(lambda: load_agent(folder, "plan"), "'plan'", "planner, gated, background, actor, random")
    assert_refused(lambda: load_agent(folder, horizn=3), "'horizn'", "did you mean horizon?")
    assert_refused(lambda: load_agent(folder, horizon=0), "horizon")
    assert_refused(lambda: load_agent(folder, horizon="far"), "planner settings")
    assert_refused(lambda: load_agent(folder, smoothing=0.0), "smoothing")
    assert_refused(lambda: load_agent(folder, device="gpu"), "'gpu'")


def test_settings_of_the_search_can_be_replaced(folder):
    agent = load_agent(folder, horizon=5, num_samples=20)
    assert (agent.controller.planner.horizon, agent.controller.planner.num_samples) == (5, 20)
    agent.act(FRAMES[0])
    assert agent.controller.plan.mean.shape == (1, 5, 2)


def test_agents_that_plan_in_real_time_take_their_settings(folder):
    gated = load_agent(folder, "gated", planning_budget=0.1, signal="random", horizon=4)
    assert (gated.planning_budget, gated.signal, gated.controller.planner.horizon) == (0.1, "random", 4)
    with load_agent(folder, "background", worker="thread", max_age=2, deadline_ms=50.0) as agent:
        assert (agent.scheduler.buffer.max_age, agent.scheduler.planner.deadline_ms) == (2, 50.0)
        assert agent.act(FRAMES[0]).shape == (2,)
    assert_refused(lambda: load_agent(folder, "gated", planning_budget=2), "planning_budget", "[0, 1]")
    assert_refused(lambda: load_agent(folder, "gated", planing_budget=2), "did you mean planning_budget?")
    assert_refused(lambda: load_agent(folder, "background", worker="fork"), "process, thread")
    assert_refused(lambda: load_agent(folder, planning_budget=0.1), "'planning_budget'")


def test_agents_act_without_lightning_or_a_simulator(folder, run_python):
    program = f"""
import sys
class Block:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in ("lightning", "dm_control", "mujoco", "gymnasium", "cv2"):
            raise ImportError(name)
sys.meta_path.insert(0, Block())
import numpy as np
from latentplan import load_agent
agent = load_agent({str(folder)!r})
print(agent.act(np.zeros((64, 64, 3), np.uint8)).shape)
"""
    finished = run_python("-c", program)
    assert finished.returncode == 0, finished.stderr
    assert finished.stdout == "(2,)\n"
