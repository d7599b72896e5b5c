"""The commands card, push and pull: what they write, what they leave alone, and what they refuse."""

import re
import shutil

import pytest

from latentplan.commands.main import main
from latentplan.reporting.card import read_seal
from tests.commands.conftest import count_frames


@pytest.fixture
def agent(checkpoint, tmp_path):
    """A copy of the agent that a test may change."""
    return shutil.copytree(checkpoint, tmp_path / "agent")


def run_card(folder, *flags):
    return main(["card", "--checkpoint", str(folder), "--device", "cpu", *map(str, flags)])


def test_card_is_written_beside_an_agent_that_loads_as_before(agent, capsys):
    before = {path.name: path.read_bytes() for path in agent.iterdir()}
    assert run_card(agent) == 0
    assert "remembers no returns" in capsys.readouterr().out
    after = {path.name: path.read_bytes() for path in agent.iterdir()}
    assert read_seal(after.pop("README.md").decode()).is_intact
    assert after == before


def test_card_of_a_run_lies_beside_its_best_agent(run_folder, tmp_path):
    run = shutil.copytree(run_folder, tmp_path / "run")
    assert run_card(run) == 0
    assert (run / "checkpoints" / "best" / "README.md").is_file()


def test_python_of_the_card_runs(agent, monkeypatch, tmp_path):
    run_card(agent)
    agent.rename(tmp_path / "cartpole-swingup")
    monkeypatch.chdir(tmp_path)
    card = (tmp_path / "cartpole-swingup" / "README.md").read_text()
    (block,) = re.findall(r"^```python\n(.*?)^```", card, flags=re.DOTALL | re.MULTILINE)
    exec(compile(block, "card", "exec"), {})


def test_measured_card_has_returns_and_a_film_of_the_first_episode(agent, capsys):
    assert run_card(agent, "--episodes", 2) == 0
    printed = dict(
        re.findall(r"^(planner|actor): mean return (-?[\d.]+) of 2 episodes$", capsys.readouterr().out, re.M)
    )
    card = (agent / "README.md").read_text()
    assert set(printed) == {"planner", "actor"}
    for mode, mean in printed.items():
        assert re.search(rf"^\| {mode} \| 2 \| {re.escape(mean)} \|.*for this card, seed 0", card, re.M)
        assert re.search(rf"value: {re.escape(mean)}\n +name: mean_reward \({mode}, 2 episodes", card)
    assert "[replay.mp4](replay.mp4)" in card
    assert count_frames(agent / "replay.mp4")[0] == 11
    assert run_card(agent) == 0  # without returns of its own, the card has no film either
    assert "replay.mp4" not in (agent / "README.md").read_text() and not (agent / "replay.mp4").exists()


def test_card_that_was_written_before_is_replaced_and_an_edited_one_is_kept(agent, capsys):
    path = agent / "README.md"
    assert run_card(agent) == 0 and run_card(agent, "--licence", "apache-2.0") == 0
    assert "license: apache-2.0" in path.read_text()
    for text, words in (("# Mine\n", "was not written by"), (path.read_text().replace("# c", "# C"), "was edited")):
        path.write_text(text)
        assert run_card(agent) == 2
        assert words in capsys.readouterr().err and path.read_text() == text
    assert run_card(agent, "--force", "true") == 0
    assert read_seal(path.read_text()).is_intact


def test_film_of_another_origin_is_kept(agent, capsys):
    (agent / "replay.mp4").write_bytes(b"my film")
    assert run_card(agent, "--episodes", 1) == 2
    assert "replay.mp4 was not written by this command" in capsys.readouterr().err
    assert (agent / "replay.mp4").read_bytes() == b"my film" and not (agent / "README.md").exists()


@pytest.mark.parametrize(
    ("flags", "words"),
    [
        (["--episodes", 0], "--episodes"),
        (["--seed", 7], "--seed has no effect without --episodes"),
        (["--licence", "My own"], "--licence must be an identifier"),
        (["--env-kwargs", "{}"], "--env-kwargs has no effect"),
    ],
)
def test_card_refuses_wrong_flags(flags, words, agent, assert_refused):
    assert_refused(["card", "--checkpoint", agent, *flags], words)


def test_card_refuses_a_damaged_agent(agent, assert_refused):
    (agent / "weights.safetensors").write_bytes(b"damaged")
    assert_refused(["card", "--checkpoint", agent], "weights.safetensors is damaged")
    assert not (agent / "README.md").exists()


@pytest.mark.parametrize(
    ("argv", "words"),
    [
        (["push", "ann/pole"], "flag --checkpoint is missing"),
        (["push", "--checkpoint", "{agent}"], "word REPO is missing"),
        (["push", "--checkpoint", "{agent}", "pole"], "a repository is named OWNER/NAME"),
        (["push", "--checkpoint", "{agent}", "../../pole"], "a repository is named OWNER/NAME"),
        (["push", "--checkpoint", "{agent}", "ann/pole", "--endpoint", "file:///"], "--endpoint must begin"),
        (["pull", "ann/pole"], "flag --out is missing"),
        (["pull", "ann/pole", "--out", "{agent}", "--endpoint", "http://127.0.0.1:9"], "give a new folder"),
    ],
)
def test_push_and_pull_refuse_wrong_words(argv, words, agent, assert_refused):
    pytest.importorskip("huggingface_hub")
    assert_refused([word.replace("{agent}", str(agent)) for word in argv], words)


def test_push_refuses_the_card_of_an_earlier_agent(agent, assert_refused, capsys):
    pytest.importorskip("huggingface_hub")
    from latentplan.agents.checkpoint import load_model, save_checkpoint

    run_card(agent)
    model, config, info = load_model(agent)
    save_checkpoint(agent, model, config, info | {"env_frames": 9999})
    capsys.readouterr()
    assert_refused(
        ["push", "--checkpoint", agent, "ann/pole", "--endpoint", "http://127.0.0.1:9"],
        "describes an earlier agent of this folder",
    )


def test_push_without_the_client_names_the_extra(agent, assert_refused, monkeypatch):
    from importlib import util

    monkeypatch.setattr(util, "find_spec", lambda name: None)
    line = "this command needs huggingface_hub, which is not installed; run: pip install 'latentplan[hub]'"
    assert_refused(["push", "--checkpoint", agent, "ann/pole"], line)
    assert_refused(["pull", "ann/pole", "--out", agent.parent / "new"], line)


def test_agent_with_its_card_travels_over_the_hub(agent, tmp_path, monkeypatch, capsys):
    pytest.importorskip("huggingface_hub")
    from tests.agents.hub_server import TOKEN, StandIn

    monkeypatch.setenv("HF_TOKEN", TOKEN)
    hub = StandIn()
    try:
        run_card(agent)
        place = ["ann/pole", "--endpoint", hub.url]
        assert main(["push", "--checkpoint", str(agent), "--private", "true", *place]) == 0
        assert main(["pull", "--out", str(tmp_path / "pulled"), *place]) == 0
    finally:
        hub.close()
    lines = capsys.readouterr().out.splitlines()
    assert lines[-2].startswith(f"{hub.url}/ann/pole/commit/")
    assert lines[-1] == f"{tmp_path / 'pulled'}: the agent of ann/pole at commit {lines[-2].rpartition('/')[2]}"
    pulled = tmp_path / "pulled"
    assert {path.name: path.read_bytes() for path in pulled.iterdir()} == {
        path.name: path.read_bytes() for path in agent.iterdir()
    }
    assert run_card(pulled) == 0  # a card that travelled is still known


def test_card_leaves_nothing_behind_when_the_agent_is_replaced_meanwhile(agent, capsys, monkeypatch):
    from latentplan.agents.checkpoint import load_model, save_checkpoint
    from latentplan.reporting import card

    render = card.render_card

    def render_slowly(data):
        model, config, info = load_model(agent)
        save_checkpoint(agent, model, config, info | {"env_frames": 9999})
        return render(data)

    monkeypatch.setattr(card, "render_card", render_slowly)
    assert run_card(agent) == 2
    assert "was replaced while its card was made" in capsys.readouterr().err
    assert {path.name for path in agent.iterdir()} == {"info.json", "weights.safetensors", "manifest.json"}


def test_card_refuses_another_environment_than_the_agent_learned_in(agent, assert_refused):
    import json

    info = json.loads((agent / "info.json").read_text())
    info["config"]["env"] |= {"suite": "gymnasium", "domain": "gymnasium", "task": "InvertedPendulum-v5"}
    (agent / "info.json").write_text(json.dumps(info))
    (agent / "manifest.json").unlink()
    assert_refused(
        ["card", "--checkpoint", agent, "--env-id", "Reacher-v5", "--episodes", 1],
        "Reacher-v5 is another environment than InvertedPendulum-v5",
    )
