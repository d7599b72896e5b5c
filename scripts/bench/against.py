"""A benchmark of this tree and of another commit, timed in turns, each run in a process of its own."""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from statistics import median
from typing import Any

from latentplan.config import UserError

ROOT = Path(__file__).resolve().parents[2]
ROUNDS = 3


def find_commit(revision: str) -> str:
    """The full name of a commit.

    Raises:
        UserError: There is no such commit in this checkout, or no git.
    """
    commit = _git("rev-parse", "--verify", "--quiet", "--end-of-options", f"{revision}^{{commit}}")
    if commit is None:
        raise UserError(f"--against {revision!r} is no commit of this checkout")
    return commit


def compare_with(commit: str, command: str, flags: Sequence[str], key: str) -> dict[str, Any]:
    """Speed of this tree as a ratio to the speed of another commit.

    The two trees run in turns, so that a machine that slows down slows both.

    Args:
        commit: Full name of the other commit; it is checked out into a temporary folder.
        command: The benchmark, such as `train`.
        flags: Its flags, which both trees get.
        key: Key of a speed in the JSON of the benchmark; larger is faster.

    Returns:
        `commit` (the full name of the other commit), `ratio` (median of this tree over median of the other commit), and
        `this` and `other`, the speeds of each round.

    Raises:
        UserError: The commit cannot be checked out, or one of the trees cannot run the benchmark.
    """
    speeds: dict[str, list[float]] = {"this": [], "other": []}
    with _checked_out(commit) as other:
        for _ in range(ROUNDS):
            for name, tree in (("other", other), ("this", ROOT)):
                speeds[name].append(_measure(tree, command, flags)[key])
    return {"commit": commit, "ratio": median(speeds["this"]) / median(speeds["other"]), **speeds}


@contextlib.contextmanager
def _checked_out(commit: str) -> Iterator[Path]:
    with tempfile.TemporaryDirectory() as folder:
        tree = Path(folder) / "tree"
        if _git("worktree", "add", "--detach", str(tree), commit) is None:
            raise UserError(f"--against {commit[:12]} cannot be checked out into {folder}")
        try:
            yield tree
        finally:
            _git("worktree", "remove", "--force", str(tree))


def _git(*arguments: str) -> str | None:
    """The output of git in this checkout; None if the call fails."""
    try:
        found = subprocess.run(["git", "-C", str(ROOT), *arguments], capture_output=True, text=True)
    except OSError:
        raise UserError("--against needs git, which is not installed") from None
    return found.stdout.strip() if found.returncode == 0 else None


def _measure(tree: Path, command: str, flags: Sequence[str]) -> Any:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "result.json"
        words = [sys.executable, str(tree / "scripts" / "benchmark.py"), command, *flags, "--json", str(path)]
        environment = {**os.environ, "PYTHONPATH": str(tree)}
        ended = subprocess.run(words, cwd=tree, env=environment, capture_output=True, text=True)
        if ended.returncode != 0:
            last = (ended.stderr.strip().splitlines() or ["no message"])[-1]
            raise UserError(f"benchmark.py {command} of {tree.name} ended with exit code {ended.returncode}: {last}")
        return json.loads(path.read_text())
