"""Client of a peer (a planner of another library): starts its process and sends requests."""

from __future__ import annotations

import json
import os
import subprocess
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from bench.peers.install import PEERS, PeerError, install, installed_version, last_line
from bench.peers.problem import Problem

SCRIPTS = Path(__file__).resolve().parents[2]


class JsonProcess:
    """A Python process that answers each line of JSON with a line of JSON.

    Args:
        python: The interpreter.
        arguments: Its arguments.
        log: File of the error stream.
    """

    def __init__(self, python: Path, arguments: Sequence[str], log: Path) -> None:
        paths = [str(SCRIPTS), str(SCRIPTS.parent), os.environ.get("PYTHONPATH", "")]
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, paths))}
        self._log = log
        with log.open("w") as stream:
            self._process = subprocess.Popen(
                [str(python), *arguments],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=stream,
                cwd=log.parent,
                env=environment,
                text=True,
            )

    def ask(self, request: dict[str, Any]) -> dict[str, Any]:
        """The answer to a request.

        Raises:
            PeerError: The process ended; the message is the last line of its error stream.
        """
        assert self._process.stdin is not None and self._process.stdout is not None
        try:
            print(json.dumps(request), file=self._process.stdin, flush=True)
            answer = self._process.stdout.readline()
        except BrokenPipeError:
            answer = ""
        if not answer:
            self._process.wait()
            raise PeerError(
                last_line(self._log.read_text(errors="replace")) or "its process ended without an error message"
            )
        content: dict[str, Any] = json.loads(answer)
        return content

    def close(self) -> None:
        """Ends the process."""
        self._process.kill()
        self._process.communicate()


class PeerProcess(JsonProcess):
    """A peer in its own process, which runs one search per request; `name` and `version` describe the library.

    Args:
        name: One of `PEERS`.
        problem: The search.
        folder: Folder of the peers' Python environment.

    Raises:
        PeerError: The library cannot be installed.
    """

    def __init__(self, name: str, problem: Problem, folder: Path) -> None:
        python = install(name, folder)
        self.name, self.version = name, installed_version(name, folder)
        super().__init__(python, ["-m", PEERS[name].module, problem.to_json()], folder / f"{name}.log")

    def search_ms(self, dtype: str) -> float:
        """Milliseconds of one search, with the trunk of the model in `float32` or `bfloat16`.

        Raises:
            PeerError: The search failed; the message is the last line of the error.
        """
        return float(self.ask({"dtype": dtype})["ms"])
