"""The exported actor: a file that gives the agent's actions without this package."""

import json
import sys
from contextlib import contextmanager

import numpy as np
import pytest
import torch

from latentplan.agents.actor import ActorAgent
from latentplan.agents.checkpoint import load_agent, save_checkpoint
from latentplan.agents.export import export_actor
from latentplan.agents.random import RandomAgent
from latentplan.commands.main import main
from latentplan.config import Config, UserError
from latentplan.models import WorldModel
from tests.agents.small_agents import SIZES

CONFIG = Config(model=SIZES)


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory):
    torch.manual_seed(0)
    model = WorldModel(CONFIG.model, action_dim=2)
    with torch.no_grad():
        model.actor.mlp.output.weight.normal_(std=0.5)
    folder = tmp_path_factory.mktemp("agent")
    save_checkpoint(folder, model, CONFIG, {"domain": "cartpole", "task": "swingup", "env_frames": 1, "discount": 0.9})
    return folder


@pytest.fixture(scope="module")
def program(checkpoint, tmp_path_factory):
    path = tmp_path_factory.mktemp("program") / "actor.pt2"
    assert main(["export", "--checkpoint", str(checkpoint), "--out", str(path)]) == 0
    return path


@pytest.fixture(scope="module")
def module(program):
    """The exported program, ready to be called."""
    return torch.export.load(program).module()


def test_exported_program_gives_the_actions_of_the_agent(checkpoint, module):
    film = np.random.default_rng(3).integers(0, 256, (8, 3, 64, 64, 3), dtype=np.uint8)
    agent, actions, expected = load_agent(checkpoint, mode="actor"), [], []
    deter, stoch, action = (torch.full((3, size), 7.0) for size in (16, 32, 2))  # not read at first frames
    for time, frames in enumerate(film):
        if time == 5:
            agent.reset()
        action, deter, stoch = module(torch.from_numpy(frames), deter, stoch, action, torch.full((3,), time in (0, 5)))
        actions.append(action.detach().numpy())
        expected.append(agent.act(frames))
    assert np.ptp(expected) > 0.1
    assert np.allclose(actions, expected, atol=1e-4)


def test_documented_runner_gives_the_actions_of_the_agent_without_this_package(
    checkpoint, program, run_python, tmp_path, root
):
    text = (root / "docs" / "guides" / "distillation.md").read_text()
    runner = next(part for part in text.split("```python\n")[1:] if "torch.export.load" in part).split("```")[0]
    film = np.random.default_rng(0).integers(0, 256, (6, 64, 64, 3), dtype=np.uint8)
    np.save(program.parent / "film.npy", film)
    before = "import sys; sys.modules['latentplan'] = None\nimport numpy as np\n"
    actions = f"[action.detach().numpy() for action in control(np.load('film.npy'), {str(program)!r})]"
    result = run_python("-c", f"{before}{runner}\nnp.save('actions.npy', {actions})", cwd=program.parent)
    assert result.returncode == 0, result.stderr
    agent = load_agent(checkpoint, mode="actor")
    expected = np.stack([agent.act(frame) for frame in film])
    assert np.allclose(np.load(program.parent / "actions.npy")[:, 0], expected, atol=1e-4)


def test_exported_program_begins_episodes_row_by_row(module):
    frames = torch.randint(0, 256, (2, 64, 64, 3), dtype=torch.uint8, generator=torch.Generator().manual_seed(0))
    past = torch.full((2, 16), 0.3), torch.full((2, 32), -0.2), torch.full((2, 2), 0.5)
    mixed, first, later = (
        module(frames, *past, torch.tensor(flags)) for flags in ([True, False], [True, True], [False, False])
    )
    for ours, firsts, laters in zip(mixed, first, later, strict=True):
        assert torch.allclose(ours[0], firsts[0], atol=1e-5) and torch.allclose(ours[1], laters[1], atol=1e-5)
        assert not torch.allclose(firsts[1], laters[1], atol=1e-5)


def test_exported_file_holds_its_sizes_and_only_the_weights_of_the_actor(program, checkpoint):
    facts = {"actor.json": ""}
    exported = torch.export.load(program, extra_files=facts)
    assert json.loads(facts["actor.json"]) == {"deter": 16, "stoch": 32, "action": 2}
    held = sum(tensor.numel() for tensor in exported.state_dict.values())
    model = load_agent(checkpoint, mode="actor").model
    parts = (model.encoder, model.dynamics, model.actor)
    assert 0 < held <= sum(parameter.numel() for part in parts for parameter in part.parameters())


def test_export_actor_takes_an_agent_in_memory(tmp_path, module):
    torch.manual_seed(1)
    agent = ActorAgent(WorldModel(CONFIG.model, action_dim=2), CONFIG)
    path = export_actor(agent, tmp_path / "mine.pt2")
    frame = np.zeros((1, 64, 64, 3), np.uint8)
    nothing = torch.zeros(1, 16), torch.zeros(1, 32), torch.zeros(1, 2)
    ours, other = (
        program(torch.from_numpy(frame), *nothing, torch.ones(1, dtype=torch.bool))[0]
        for program in (torch.export.load(path).module(), module)
    )
    assert np.allclose(ours.detach().numpy(), agent.act(frame), atol=1e-4)
    assert not torch.allclose(ours, other)


def test_export_actor_refuses_what_was_not_trained(tmp_path):
    with pytest.raises(UserError, match="a trained agent or its folder is exported, got RandomAgent"):
        export_actor(RandomAgent(2), tmp_path / "a.pt2")


@pytest.mark.parametrize(
    ("flags", "words"),
    [
        (["--out", "actor.pt2"], ["--checkpoint"]),
        (["--checkpoint", "{checkpoint}"], ["--out"]),
        (["--checkpoint", "{checkpoint}", "--out", "a.pt2", "--format", "onx"], ["'onx'", "'onnx'"]),
        (["--checkpoint", "{checkpoint}", "--out", "nowhere/a.pt2"], ["'nowhere'"]),
        (["--checkpoint", "nothing", "--out", "a.pt2"], ["nothing"]),
        (["--checkpoint", "{checkpoint}", "--out", "a.onnx"], ["--format onnx"]),
        (["--chekpoint", "nothing", "--out", "a.pt2"], ["'--chekpoint'", "'--checkpoint'"]),
    ],
)
def test_export_command_explains_mistakes_in_one_line(flags, words, checkpoint, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["export", *[flag.format(checkpoint=checkpoint) for flag in flags]]) == 2
    captured = capsys.readouterr()
    assert captured.err.count("\n") == 1 and all(word in captured.err for word in words), captured.err
    assert list(tmp_path.iterdir()) == []


def test_export_actor_names_missing_packages_when_the_format_is_onnx(checkpoint, tmp_path, monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(UserError, match="pip install onnx onnxscript"):
        export_actor(checkpoint, tmp_path / "actor.onnx", "onnx")


def test_onnx_program_gives_the_actions_of_the_agent(checkpoint, tmp_path):
    pytest.importorskip("onnxscript")
    runtime = pytest.importorskip("onnxruntime")
    session = runtime.InferenceSession(export_actor(checkpoint, tmp_path / "actor.onnx", "onnx"))
    agent = load_agent(checkpoint, mode="actor")
    film = np.random.default_rng(0).integers(0, 256, (4, 1, 64, 64, 3), dtype=np.uint8)
    action, deter, stoch = (np.zeros((1, size), np.float32) for size in (2, 16, 32))
    for time, frame in enumerate(film):
        inputs = {"frame": frame, "deter": deter, "stoch": stoch, "action": action, "is_first": np.array([time == 0])}
        action, deter, stoch = session.run(None, inputs)
        assert np.allclose(action, agent.act(frame), atol=1e-4)


def test_export_help_imports_no_torch(run_python):
    code = (
        "import sys\nfrom latentplan.commands.main import main\n"
        "print(main(['export', '--help']), 'torch' in sys.modules, 'jsonargparse' in sys.modules)"
    )
    result = run_python("-c", code)
    assert result.stdout.endswith("0 False False\n") and "--checkpoint" in result.stdout, result.stderr


@contextmanager
def largest_file(size):
    """Lets this process write no file beyond a size in bytes, as on a full disk."""
    import resource  # Unix only

    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="limits the size of files")
def test_export_command_explains_a_full_disk_in_one_line(checkpoint, capsys, tmp_path):
    with largest_file(1000):
        code = main(["export", "--checkpoint", str(checkpoint), "--out", str(tmp_path / "a.pt2")])
    errors = capsys.readouterr().err
    assert code == 2 and errors.startswith("error: cannot write") and errors.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("default", [torch.float64, torch.bfloat16])
def test_exported_program_does_not_depend_on_the_default_dtype(default, checkpoint, module, tmp_path):
    agent = load_agent(checkpoint, mode="actor")
    torch.set_default_dtype(default)
    try:
        path = export_actor(agent, tmp_path / "actor.pt2")
    finally:
        torch.set_default_dtype(torch.float32)
    given = torch.full((3, 64, 64, 3), 100).byte(), *(torch.full((3, size), 0.5) for size in (16, 32, 2))
    found = torch.export.load(path).module()(*given, torch.arange(3) == 1)
    assert all(map(torch.allclose, found, module(*given, torch.arange(3) == 1)))
