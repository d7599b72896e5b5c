"""Agents travel over the model hub unchanged, and nothing else does; the client is real, the hub is a stand-in."""

import shutil

import numpy as np
import pytest

from latentplan.agents.checkpoint import load_agent, save_checkpoint
from latentplan.config import UserError
from tests.agents.hub_server import TOKEN, StandIn
from tests.agents.small_agents import CONFIG, make_plain_model

pytest.importorskip("huggingface_hub")

from huggingface_hub import constants  # noqa: E402

from latentplan.agents.hub import pull_agent, push_agent  # noqa: E402

INFO = {"domain": "cartpole", "task": "swingup", "env_frames": 1234, "discount": 0.9, "metrics": []}
CARD = "---\nlicense: mit\n---\n\n# An agent\n"
FILES = {"info.json", "weights.safetensors", "manifest.json", "README.md"}


@pytest.fixture(scope="module")
def agent(tmp_path_factory):
    folder = tmp_path_factory.mktemp("agent")
    save_checkpoint(folder, make_plain_model(), CONFIG, INFO)
    (folder / "README.md").write_text(CARD)
    return folder


@pytest.fixture
def copy(agent, tmp_path):
    """A copy of the agent that a test may change."""
    return shutil.copytree(agent, tmp_path / "copy")


@pytest.fixture(autouse=True)
def user(monkeypatch):
    """A user whose token the stand-in knows, without the store for chunks, which the stand-in has not."""
    monkeypatch.setenv("HF_TOKEN", TOKEN)
    monkeypatch.setattr(constants, "HF_HUB_DISABLE_XET", True)


@pytest.fixture
def make_hub():
    made = []

    def make(**options):
        made.append(StandIn(**options))
        return made[-1]

    yield make
    for hub in made:
        hub.close()


@pytest.fixture
def hub(make_hub):
    return make_hub()


def contents(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def actions(folder):
    frames = np.random.default_rng(0).integers(0, 256, (3, 64, 64, 3), dtype=np.uint8)
    player = load_agent(folder)
    player.seed(0)
    return [player.act(frame).tolist() for frame in frames]


@pytest.mark.parametrize("large", [(), (".safetensors",), (".safetensors", ".md", ".json")])
def test_agent_has_the_same_bytes_and_actions_after_push_and_pull(large, agent, make_hub, tmp_path):
    hub = make_hub(large=large)
    address = push_agent(agent, "ann/pole", endpoint=hub.url)
    commit = pull_agent("ann/pole", tmp_path / "pulled", endpoint=hub.url)
    assert address == f"{hub.url}/ann/pole/commit/{commit}"
    assert contents(tmp_path / "pulled") == contents(agent)
    assert actions(tmp_path / "pulled") == actions(agent)
    assert bool(hub.objects) == bool(large)


def test_pull_takes_the_revision_that_is_asked_for(copy, hub, tmp_path):
    push_agent(copy, "ann/pole", endpoint=hub.url)
    first, before = hub.repos["ann/pole"].commits[-1][0], contents(copy)
    save_checkpoint(copy, make_plain_model(), CONFIG, INFO | {"env_frames": 9999})
    push_agent(copy, "ann/pole", endpoint=hub.url)
    assert pull_agent("ann/pole", tmp_path / "old", revision=first, endpoint=hub.url) == first
    pull_agent("ann/pole", tmp_path / "new", endpoint=hub.url)
    assert contents(tmp_path / "old") == before
    assert contents(tmp_path / "new") == contents(copy) != before


@pytest.mark.parametrize("out", [".", "empty"])
def test_pull_fills_an_empty_folder_that_keeps_its_place(out, agent, hub, tmp_path, monkeypatch):
    hub.add("ann/pole", contents(agent))
    folder = tmp_path / "here" / "empty"
    folder.mkdir(parents=True)
    before = folder.stat().st_ino
    monkeypatch.chdir(folder if out == "." else folder.parent)
    pull_agent("ann/pole", out, endpoint=hub.url)
    assert folder.stat().st_ino == before and contents(folder) == contents(agent)
    assert list(folder.parent.iterdir()) == [folder]
    hub.add("eve/pole", contents(agent) | {"weights.safetensors": b"pickle"})
    (tmp_path / "other").mkdir()
    with pytest.raises(UserError, match="cannot be used"):
        pull_agent("eve/pole", tmp_path / "other", endpoint=hub.url)
    assert not list((tmp_path / "other").iterdir())


def test_pull_fetches_the_files_of_an_agent_only(agent, hub, tmp_path):
    others = {"setup.py": b"raise SystemExit", "deep/info.json": b"{}", "replay.mp4": b"film", "model.pkl": b"p"}
    hub.add("eve/pole", contents(agent) | others)
    pull_agent("eve/pole", tmp_path / "pulled", endpoint=hub.url)
    assert set(contents(tmp_path / "pulled")) == hub.fetched() == FILES


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("weights.safetensors", b"pickle", "weights.safetensors is damaged"),
        ("info.json", b"[" * 10_000, "info.json"),
        ("manifest.json", b"{}", "manifest.json"),
    ],
)
def test_pull_places_nothing_when_the_agent_is_damaged(name, content, words, agent, hub, tmp_path):
    hub.add("eve/pole", contents(agent) | {name: content})
    with pytest.raises(UserError, match="the agent of eve/pole cannot be used") as error:
        pull_agent("eve/pole", tmp_path / "here" / "pulled", endpoint=hub.url)
    assert words in str(error.value) and str(tmp_path) not in str(error.value)
    assert not list((tmp_path / "here").iterdir())


def test_pull_places_nothing_when_the_weights_hold_nan(copy, hub, tmp_path):
    import hashlib
    import json

    from safetensors.torch import load, save

    state = load((copy / "weights.safetensors").read_bytes())
    next(iter(state.values())).fill_(float("nan"))
    info = json.loads((copy / "info.json").read_text()) | {"sha256": hashlib.sha256(save(state)).hexdigest()}
    hub.add("eve/pole", {"weights.safetensors": save(state), "info.json": json.dumps(info).encode()})
    with pytest.raises(UserError, match="is not finite"):
        pull_agent("eve/pole", tmp_path / "pulled", endpoint=hub.url)
    assert not (tmp_path / "pulled").exists()


@pytest.mark.parametrize("size", [2**33, None])
def test_pull_downloads_nothing_of_a_size_that_no_agent_has(size, agent, hub, tmp_path):
    hub.add("eve/pole", contents(agent))
    hub.told_sizes["weights.safetensors"] = size
    with pytest.raises(UserError, match="weights.safetensors of eve/pole has"):
        pull_agent("eve/pole", tmp_path / "pulled", endpoint=hub.url)
    assert not hub.fetched()


def test_pull_ends_a_download_that_is_larger_than_the_hub_said(agent, hub, tmp_path):
    hub.add("eve/pole", contents(agent) | {"README.md": b"#" * (2**20 + 1)})
    hub.told_sizes["README.md"] = 10
    with pytest.raises(UserError, match="README.md has more than 1,048,576 bytes"):
        pull_agent("eve/pole", tmp_path / "pulled", endpoint=hub.url)
    assert not (tmp_path / "pulled").exists()


def test_pull_refuses_a_folder_that_holds_something(agent, hub, tmp_path):
    hub.add("ann/pole", contents(agent))
    (tmp_path / "file").write_text("mine")
    for taken in (tmp_path, tmp_path / "file"):
        with pytest.raises(UserError, match="give a new folder"):
            pull_agent("ann/pole", taken, endpoint=hub.url)
    (tmp_path / "empty").mkdir()
    pull_agent("ann/pole", tmp_path / "empty", endpoint=hub.url)
    assert set(contents(tmp_path / "empty")) == FILES and not hub.requests[0][1].startswith("/api/repos")


@pytest.mark.parametrize(
    ("repo", "revision", "words"),
    [
        ("ann/nothing", None, "the hub shows no ann/nothing"),
        ("ann/secret", None, "hf auth login"),
        ("ann/pole", "v9", "ann/pole has no such revision"),
        ("ann/other", None, "holds no agent of latentplan: it lacks info.json and weights.safetensors"),
        ("a//b", None, "a repository is named OWNER/NAME"),
    ],
)
def test_pull_says_in_one_line_what_is_missing(repo, revision, words, agent, hub, tmp_path, monkeypatch):
    monkeypatch.delenv("HF_TOKEN")
    monkeypatch.setattr(constants, "HF_TOKEN_PATH", str(tmp_path / "no-token"))
    hub.add("ann/pole", contents(agent))
    hub.add("ann/secret", contents(agent), private=True)
    hub.add("ann/other", {"README.md": b"# Something else"})
    with pytest.raises(UserError, match=words) as error:
        pull_agent(repo, tmp_path / "pulled", revision=revision, endpoint=hub.url)
    assert "\n" not in str(error.value)


def test_hub_that_cannot_be_reached_is_one_line(agent, make_hub, tmp_path):
    hub = make_hub()
    hub.close()
    for call in (
        lambda: pull_agent("ann/pole", tmp_path / "pulled", endpoint=hub.url),
        lambda: push_agent(agent, "ann/pole", endpoint=hub.url),
    ):
        with pytest.raises(UserError, match="could not be exchanged with the hub: ConnectError"):
            call()


def test_push_without_a_token_is_refused_in_one_line(agent, hub, tmp_path, monkeypatch):
    monkeypatch.delenv("HF_TOKEN")
    monkeypatch.setattr(constants, "HF_TOKEN_PATH", str(tmp_path / "no-token"))
    with pytest.raises(UserError, match="refused ann/pole with status 401.*hf auth login"):
        push_agent(agent, "ann/pole", endpoint=hub.url)
    assert not hub.repos


def test_push_makes_a_private_repository_and_never_uses_a_public_one_for_it(agent, hub):
    push_agent(agent, "ann/secret", private=True, endpoint=hub.url)
    assert hub.repos["ann/secret"].private
    push_agent(agent, "ann/pole", endpoint=hub.url)
    num_commits = len(hub.repos["ann/pole"].commits)
    with pytest.raises(UserError, match="ann/pole exists and is public"):
        push_agent(agent, "ann/pole", private=True, endpoint=hub.url)
    assert len(hub.repos["ann/pole"].commits) == num_commits


def test_push_needs_a_card_and_a_whole_agent(copy, hub):
    (copy / "README.md").unlink()
    with pytest.raises(UserError, match="has no README.md: write it with `latentplan card"):
        push_agent(copy, "ann/pole", endpoint=hub.url)
    (copy / "README.md").write_text(CARD)
    (copy / "weights.safetensors").write_bytes(b"damaged")
    with pytest.raises(UserError, match="is damaged"):
        push_agent(copy, "ann/pole", endpoint=hub.url)
    assert not hub.requests


def test_push_leaves_a_repository_of_something_else_as_it_is(agent, hub):
    hub.add("ann/other", {"README.md": b"# Something else", "model.bin": b"1"})
    with pytest.raises(UserError, match="ann/other holds something other than an agent"):
        push_agent(agent, "ann/other", endpoint=hub.url)
    assert hub.files("ann/other") == {"README.md": b"# Something else", "model.bin": b"1"}


def test_push_uploads_the_film_of_the_card_and_deletes_the_film_of_an_earlier_one(copy, hub):
    (copy / "replay.mp4").write_bytes(b"film")
    (copy / "notes.txt").write_text("private notes")
    (copy / "README.md").write_text(f"{CARD}[replay.mp4](replay.mp4)\n")
    push_agent(copy, "ann/pole", endpoint=hub.url)
    assert set(hub.files("ann/pole")) == FILES | {"replay.mp4", ".gitattributes"}
    (copy / "README.md").write_text(CARD)
    push_agent(copy, "ann/pole", endpoint=hub.url)
    assert set(hub.files("ann/pole")) == FILES | {".gitattributes"}


def test_push_that_the_hub_finds_wrong_commits_nothing(copy, hub):
    (copy / "README.md").write_text("# No metadata\n")
    with pytest.raises(UserError, match="Invalid metadata in README.md"):
        push_agent(copy, "ann/pole", endpoint=hub.url)
    assert set(hub.files("ann/pole")) == {".gitattributes"}
