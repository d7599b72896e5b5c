"""Agents on the model hub: uploads and downloads by `huggingface_hub`, of the files of an agent alone.

The library finds the address of the hub and the user's token as its own command `hf` does. What a repository holds is
not trusted: only files with the names of an agent's files are fetched, within limits of size, and the agent is checked
as every agent is before it gets its place. Torch is imported for this check, so that mistakes before it answer at once.
"""

from __future__ import annotations

import contextlib
import tempfile
from collections.abc import Iterator, Mapping
from importlib import import_module
from pathlib import Path
from typing import Any

from latentplan import __version__
from latentplan.agents.files import CARD, FILM, INFO, LARGEST, WEIGHTS, read_files
from latentplan.agents.info import resolve_checkpoint
from latentplan.config import UserError
from latentplan.config.checks import make_folder, shown
from latentplan.config.extras import import_extra
from latentplan.config.manifest import MANIFEST
from latentplan.config.reading import read_bytes

CLIENT = "huggingface_hub"
LARGEST_CARD = 2**20  # bytes
LARGEST_MANIFEST = 2**16  # bytes; that of an agent has some hundreds
LARGEST_FILM = 2**28  # bytes
NEEDED = (INFO, WEIGHTS)
PULLED = {**LARGEST, MANIFEST: LARGEST_MANIFEST, CARD: LARGEST_CARD}
"""The files that `pull_agent` fetches, and the largest size of each in bytes."""


def push_agent(path: str | Path, repo: str, *, private: bool = False, endpoint: str | None = None) -> str:
    """Uploads an agent and its card to the model hub, as one commit.

    The agent that is uploaded is a copy that `load_agent` has accepted. The film goes with it if the card names it. A
    film or manifest of an earlier agent in the repository is deleted.

    Args:
        path: A checkpoint, or a run folder (its best checkpoint, else its last).
        repo: The repository, as OWNER/NAME; it is made if it does not exist.
        private: Whether the repository must be private.
        endpoint: Address of the hub; None takes that of `huggingface_hub`.

    Returns:
        The address of the commit.

    Raises:
        UserError: The agent cannot be used or has no card, the repository is public or holds something else, or the
            hub refuses the upload or cannot be reached.
    """
    hub = import_extra(CLIENT, "the model hub")
    folder = resolve_checkpoint(path)
    with tempfile.TemporaryDirectory() as made:
        staged = Path(made)
        _stage(folder, staged)
        _check(staged)
        api = hub.HfApi(endpoint=endpoint, library_name="latentplan", library_version=__version__)
        with _one_line(repo):
            api.create_repo(repo, private=private, exist_ok=True)
            found = api.model_info(repo)
            present = {each.rfilename for each in found.siblings or ()}
        if private and not found.private:
            raise UserError(f"{repo} exists and is public: make it private on the hub, or give another name")
        if CARD in present and not present.issuperset(NEEDED):
            raise UserError(f"{repo} holds something other than an agent: give another name")
        names = sorted(each.name for each in staged.iterdir())
        operations = [hub.CommitOperationAdd(name, staged / name) for name in names]
        stale = sorted((present & {MANIFEST, FILM}).difference(names))
        operations += [hub.CommitOperationDelete(name) for name in stale]
        with _one_line(repo):
            commit = api.create_commit(repo, operations, commit_message="Upload an agent of latentplan")
    return str(commit.commit_url)


def pull_agent(repo: str, out: str | Path, *, revision: str | None = None, endpoint: str | None = None) -> str:
    """Downloads an agent from the model hub into a new folder, after `load_agent` has accepted it.

    Args:
        repo: The repository, as OWNER/NAME.
        out: Folder of the agent; it must not exist, or be empty.
        revision: Branch, tag or commit; None takes the main branch.
        endpoint: Address of the hub; None takes that of `huggingface_hub`.

    Returns:
        The commit of the repository that the agent is from.

    Raises:
        UserError: The folder is not free, the repository holds no agent or one that cannot be used, a file is too
            large, or the hub cannot be reached.
    """
    hub, out = import_extra(CLIENT, "the model hub"), Path(out)
    _require_free(out)
    api = hub.HfApi(endpoint=endpoint, library_name="latentplan", library_version=__version__)
    with _one_line(repo):
        found = api.model_info(repo, revision=revision, files_metadata=True)
        commit, sizes = str(found.sha), {each.rfilename: each.size for each in found.siblings or ()}
    names = _choose_files(repo, sizes)
    is_there = out.is_dir()  # it may be the working folder or a mount point, which keep their place
    make_folder(out.parent)
    with tempfile.TemporaryDirectory(prefix=f".{out.name}.", dir=out if is_there else out.parent) as made:
        fetched, agent = Path(made) / "fetched", Path(made) / "agent"
        agent.mkdir()
        for name in names:
            with _one_line(repo):
                given = api.hf_hub_download(
                    repo,
                    name,
                    revision=commit,
                    local_dir=fetched,
                    cache_dir=Path(made) / "cache",
                    tqdm_class=_limited_progress(name, PULLED[name]),
                )
            (agent / name).write_bytes(read_bytes(Path(given), PULLED[name]))
        try:
            _check(agent)
        except UserError as error:
            reason = str(error).replace(f"{agent}/", "").replace(str(agent), "the repository")
            raise UserError(f"the agent of {repo} cannot be used: {reason}") from None
        if not is_there:
            agent.replace(out)
        for name in sorted(names, key=lambda name: name == MANIFEST) if is_there else ():  # the manifest last
            (agent / name).replace(out / name)
    return commit


def _check(folder: Path) -> None:
    """Refuses an agent that cannot act.

    Raises:
        UserError: See `load_agent`.
    """
    from latentplan.agents.checkpoint import load_agent

    load_agent(folder)


def _require_free(out: Path) -> None:
    """Refuses a folder that holds something, or cannot be there.

    Raises:
        UserError: Another folder has to be given.
    """
    try:
        is_taken = out.is_symlink() or (out.exists() and (not out.is_dir() or any(out.iterdir())))
    except OSError as error:  # such as a name that is too long
        raise UserError(f"{out} cannot be made: {error.strerror}; give another folder") from None
    if is_taken:
        raise UserError(f"{out} exists: give a new folder")


def _stage(folder: Path, staged: Path) -> None:
    """Copies what is uploaded of an agent.

    Raises:
        UserError: A file is missing, damaged or too large.
    """
    if not (folder / CARD).exists():
        raise UserError(f"{folder} has no {CARD}: write it with `latentplan card --checkpoint {folder}`")
    contents = read_files(folder, NEEDED)
    contents[CARD] = read_bytes(folder / CARD, LARGEST_CARD)
    if (folder / MANIFEST).exists():
        contents[MANIFEST] = read_bytes(folder / MANIFEST, LARGEST_MANIFEST)
    if f"]({FILM})".encode() in contents[CARD] and (folder / FILM).exists():
        contents[FILM] = read_bytes(folder / FILM, LARGEST_FILM)
    for name, content in contents.items():
        (staged / name).write_bytes(content)


def _choose_files(repo: str, sizes: Mapping[str, int | None]) -> list[str]:
    """The names of the files to fetch.

    Args:
        repo: The repository.
        sizes: Bytes of every file of the repository, as the hub gives them.

    Raises:
        UserError: A file of an agent is missing or too large, or its size is unknown.
    """
    missing = [name for name in NEEDED if name not in sizes]
    if missing:
        raise UserError(f"{repo} holds no agent of latentplan: it lacks {' and '.join(missing)}")
    names = [name for name in PULLED if name in sizes]
    for name in names:
        size = sizes[name]
        if size is None or size > PULLED[name]:
            told = "a size that the hub does not tell" if size is None else f"{size:,} bytes"
            raise UserError(f"{name} of {repo} has {told}; an agent's has at most {PULLED[name]:,}")
    return names


def _limited_progress(name: str, largest: int) -> type:
    """A progress bar of the client that ends a download that goes on beyond a size.

    Args:
        name: Name of the file.
        largest: Largest size in bytes.
    """
    received = 0

    def update(bar: Any, n: float | None = 1) -> bool | None:
        nonlocal received
        received += int(n or 0)
        if received > largest:
            raise OSError(f"{name} has more than {largest:,} bytes")
        return shows.update(bar, n)

    shows: Any = import_module(f"{CLIENT}.utils").tqdm
    return type("LimitedProgress", (shows,), {"update": update})


@contextlib.contextmanager
def _one_line(repo: str) -> Iterator[None]:
    """Turns the errors of the client about a repository into a `UserError`."""
    errors = import_module(f"{CLIENT}.errors")
    try:
        yield
    except errors.HFValidationError:
        raise UserError(f"a repository is named OWNER/NAME, got {shown(repo)}") from None
    except errors.RevisionNotFoundError:
        raise UserError(f"{repo} has no such revision: give a branch, a tag or a commit") from None
    except errors.RepositoryNotFoundError:
        raise UserError(f"the hub shows no {repo}: it does not exist, or `hf auth login` has to come first") from None
    except errors.HfHubHTTPError as error:
        code = error.response.status_code
        reason = error.server_message or str(error).strip().partition("\n")[0]
        login = "; `hf auth login` names you to the hub" if code in (401, 403) else ""
        raise UserError(f"the hub refused {repo} with status {code}: {' '.join(reason.split())}{login}") from None
    except Exception as error:  # client, transport and answers of another form raise errors of many types
        reason = " ".join(str(error).split()) or "no reason given"
        raise UserError(f"{repo} could not be exchanged with the hub: {type(error).__name__}: {reason}") from None
