"""Checkpoints: loading restores the saved agent, or fails with the reason in one line."""

import copy
import hashlib
import json

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file

from latentplan.agents.checkpoint import load_agent, load_model, read_info, resolve_checkpoint, save_checkpoint
from latentplan.agents.planning import PlanningAgent
from latentplan.config import Config, EnvConfig, PlannerConfig, UserError
from latentplan.models import WorldModel
from latentplan.models.fast import accelerate
from tests.agents.small_agents import SIZES, make_plain_model

CONFIG = Config(
    env=EnvConfig(domain="cartpole", task="swingup"),
    model=SIZES,
    planner=PlannerConfig(horizon=3, num_samples=16, num_elites=4, num_iterations=2, num_policy_samples=2),
)
INFO = {"domain": "cartpole", "task": "swingup", "env_frames": 1000, "discount": 0.9, "metrics": [{"planner": 1.5}]}
FRAMES = np.random.default_rng(0).integers(0, 256, (4, 64, 64, 3), dtype=np.uint8)


@pytest.fixture(scope="module")
def model():
    model = accelerate(make_plain_model(heads=("reward_head",)))
    with torch.no_grad():
        # A checkpoint holds float16, so that only float16 weights are restored exactly.
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


def unseal(folder):
    """Deletes the manifest, as a user does after a deliberate change."""
    (folder / "manifest.json").unlink()


def change_info(folder, **changes):
    unseal(folder)
    path = folder / "info.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))


def history(agent):
    agent.seed(0)
    return np.stack([agent.act(frame) for frame in FRAMES])


def test_load_model_restores_weights_and_settings(model, folder):
    loaded, config, info = load_model(folder)
    assert config == CONFIG
    assert info.items() >= INFO.items()
    assert all(torch.equal(value, loaded.state_dict()[name]) for name, value in model.state_dict().items())


@pytest.mark.parametrize("mode", ["planner", "gated", "actor", "random"])
def test_load_agent_gives_the_same_actions_each_time(folder, mode):
    first, second = history(load_agent(folder, mode)), history(load_agent(folder, mode))
    assert first.shape == (4, 2)
    assert np.array_equal(first, second)


def test_load_agent_gives_the_actions_of_the_saved_agent(model, folder):
    before = PlanningAgent(model, CONFIG, 0.9)
    assert np.array_equal(history(before), history(load_agent(folder)))
    assert load_agent(folder).encode(FRAMES[0]).shape == (32,)


def test_save_checkpoint_replaces_an_earlier_one(model, folder):
    save_checkpoint(folder, model, CONFIG, INFO | {"env_frames": 2000})
    assert read_info(folder)["env_frames"] == 2000
    assert sorted(path.name for path in folder.iterdir()) == ["info.json", "manifest.json", "weights.safetensors"]
    load_model(folder)


def test_save_checkpoint_gives_both_files_the_same_permissions(folder):
    assert len({oct(path.stat().st_mode) for path in folder.iterdir()}) == 1
    assert (folder / "info.json").read_text().endswith("}\n")


def test_read_info_takes_the_best_checkpoint_of_a_run_else_the_last(model, tmp_path):
    save_checkpoint(tmp_path / "checkpoints" / "last", model, CONFIG, INFO | {"env_frames": 2})
    assert read_info(tmp_path)["env_frames"] == 2
    save_checkpoint(tmp_path / "checkpoints" / "best", model, CONFIG, INFO | {"env_frames": 1})
    assert read_info(str(tmp_path))["env_frames"] == 1


def test_save_checkpoint_stays_below_2_5_megabytes_with_default_sizes(tmp_path):
    config = Config()
    save_checkpoint(tmp_path, WorldModel(config.model, action_dim=6), config, INFO)
    assert sum(path.stat().st_size for path in tmp_path.iterdir()) <= 2.5e6


@pytest.mark.parametrize("place", [0.1, 0.5, 0.999])
def test_load_agent_refuses_weights_with_a_changed_byte(folder, place):
    path = folder / "weights.safetensors"
    content = bytearray(path.read_bytes())
    content[int(place * len(content))] ^= 1
    path.write_bytes(content)
    assert_refused(lambda: load_agent(folder), "damaged", "weights.safetensors")


def test_load_agent_refuses_weights_that_are_cut_off(folder):
    path = folder / "weights.safetensors"
    path.write_bytes(path.read_bytes()[:-100])
    assert_refused(lambda: load_agent(folder), "damaged")


@pytest.mark.parametrize("content", ["{}", "[1, 2]", "nonsense", '{"config": {}}'])
def test_read_info_refuses_descriptions_of_other_programs(folder, content):
    unseal(folder)
    (folder / "info.json").write_text(content)
    assert_refused(lambda: read_info(folder), "info.json")


@pytest.mark.parametrize("key", ["domain", "task", "env_frames", "discount", "action_dim", "config", "sha256"])
def test_read_info_names_a_missing_key(folder, key):
    facts = json.loads((folder / "info.json").read_text())
    del facts[key]
    unseal(folder)
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
def test_load_agent_names_a_setting_that_is_unknown_or_not_allowed(folder, config, word):
    change_info(folder, config=config)
    assert_refused(lambda: load_agent(folder), "info.json", word)


@pytest.mark.parametrize(
    ("key", "value"),
    [("env_frames", None), ("action_dim", "two"), ("discount", "high"), ("labels", [1]), ("sha256", 3)],
)
def test_load_agent_refuses_values_of_another_type(folder, key, value):
    change_info(folder, **{key: value})
    assert_refused(lambda: load_agent(folder), "info.json", key)


@pytest.mark.parametrize("action_dim", [-1, 0])
def test_load_agent_refuses_action_sizes_below_1(folder, action_dim):
    change_info(folder, action_dim=action_dim)
    assert_refused(lambda: load_agent(folder), "action_dim must be an integer in [1, 4096]")


@pytest.mark.parametrize("number", ["nan", "inf"])
def test_load_agent_refuses_weights_that_are_not_finite(folder, number):
    path = folder / "weights.safetensors"
    weights = load_file(path)
    weights["reward_head.mlp.output.bias"][0] = float(number)
    save_file(weights, path)
    change_info(folder, sha256=hashlib.sha256(path.read_bytes()).hexdigest())
    assert_refused(lambda: load_agent(folder), "reward_head.mlp.output.bias", "not finite")


def test_save_checkpoint_refuses_weights_beyond_float16_and_leaves_the_folder(model, folder):
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    large = copy.deepcopy(model)
    with torch.no_grad():
        large.actor.mlp.output.weight[0, 0] = 1e5
    with pytest.raises(FloatingPointError, match=r"actor\.mlp\.output\.weight"):
        save_checkpoint(folder, large, CONFIG, INFO)
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before


@pytest.mark.parametrize("mode", ["actor", "random"])
def test_load_agent_refuses_planner_settings_when_the_mode_does_not_plan(folder, mode):
    assert_refused(lambda: load_agent(folder, mode=mode, horizon=3), "horizon has no effect", mode)


def test_load_agent_refuses_weights_of_other_sizes(folder):
    change_info(folder, action_dim=3)
    assert_refused(lambda: load_agent(folder), "does not fit")


def test_load_agent_refuses_folders_without_a_checkpoint(tmp_path):
    assert_refused(lambda: load_agent(tmp_path / "nothing"), "does not exist")
    assert_refused(lambda: load_agent(tmp_path), "expected weights.safetensors and info.json")


def test_resolve_checkpoint_suggests_the_nearest_folder(folder, model, tmp_path):
    save_checkpoint(tmp_path / "walker-run" / "checkpoints" / "last", model, CONFIG, INFO)
    message = assert_refused(lambda: resolve_checkpoint(tmp_path / "wlker-run"), "did you mean")
    assert message.endswith(f"{tmp_path / 'walker-run'}?")
    message = assert_refused(lambda: resolve_checkpoint(tmp_path / "xyz"), "available: ")
    assert str(folder) in message and str(tmp_path / "walker-run") in message


def test_resolve_checkpoint_suggests_shipped_checkpoints(model, tmp_path, monkeypatch):
    save_checkpoint(tmp_path / "checkpoints" / "walker", model, CONFIG, INFO)
    monkeypatch.chdir(tmp_path)
    assert_refused(lambda: resolve_checkpoint("elsewhere/walkr"), "did you mean checkpoints/walker?")


@pytest.mark.parametrize("path", ["run/reach", "reach", "runs"])
def test_resolve_checkpoint_suggests_the_users_own_runs(path, model, tmp_path, monkeypatch):
    save_checkpoint(tmp_path / "runs" / "reach" / "checkpoints" / "last", model, CONFIG, INFO)
    monkeypatch.chdir(tmp_path)
    assert_refused(lambda: resolve_checkpoint(path), "runs/reach")


def test_load_agent_names_a_mode_setting_or_device_that_does_not_exist(folder):
    assert_refused(lambda: load_agent(folder, "plan"), "'plan'", "planner, gated, background, actor, random")
    assert_refused(lambda: load_agent(folder, horizn=3), "'horizn'", "did you mean horizon?")
    assert_refused(lambda: load_agent(folder, horizon=0), "horizon")
    assert_refused(lambda: load_agent(folder, horizon="far"), "planner settings")
    assert_refused(lambda: load_agent(folder, smoothing=0.0), "smoothing")
    assert_refused(lambda: load_agent(folder, device="gpu"), "'gpu'")


def test_load_agent_replaces_planner_settings(folder):
    agent = load_agent(folder, horizon=5, num_samples=20)
    assert (agent.controller.planner.horizon, agent.controller.planner.num_samples) == (5, 20)
    agent.act(FRAMES[0])
    assert agent.controller.plan.mean.shape == (1, 5, 2)


def test_load_agent_passes_on_the_options_of_gated_and_background_agents(folder):
    gated = load_agent(folder, "gated", planning_budget=0.1, signal="random", horizon=4)
    assert (gated.planning_budget, gated.signal, gated.controller.planner.horizon) == (0.1, "random", 4)
    with load_agent(folder, "background", worker="thread", max_age=2, deadline_ms=50.0) as agent:
        assert (agent.scheduler.buffer.max_age, agent.scheduler.planner.deadline_ms) == (2, 50.0)
        assert agent.act(FRAMES[0]).shape == (2,)
    assert_refused(lambda: load_agent(folder, "gated", planning_budget=2), "planning_budget", "[0, 1]")
    assert_refused(lambda: load_agent(folder, "gated", planing_budget=2), "did you mean planning_budget?")
    assert_refused(lambda: load_agent(folder, "background", worker="fork"), "process, thread")
    assert_refused(lambda: load_agent(folder, planning_budget=0.1), "'planning_budget'")


def test_load_agent_needs_neither_lightning_nor_a_simulator(folder, run_python):
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


@pytest.mark.parametrize("mode", ["planner", "gated", "actor"])
def test_agent_loaded_in_inference_mode_acts_outside_and_inside_it(mode, folder):
    expected = load_agent(folder, mode).act(FRAMES[0])
    with torch.inference_mode():
        agent = load_agent(folder, mode)
    assert np.array_equal(agent.act(FRAMES[0]), expected)
    agent.reset()
    with torch.inference_mode():
        assert agent.act(FRAMES[0]).shape == expected.shape
