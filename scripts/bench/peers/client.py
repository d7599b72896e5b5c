"""Client of a peer (a planner of another library): starts its process and sends requests."""

from __future__ import annotations

import json
import os
import subprocess
from pathlib import Path

from bench.peers.install import PEERS, PeerError, install, installed_version, last_line
from bench.peers.problem import Problem

SCRIPTS = Path(__file__).resolve().parents[2]


class PeerProcess:
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
        paths = [str(SCRIPTS), str(SCRIPTS.parent), os.environ.get("PYTHONPATH", "")]
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, paths))}
        self.name, self.version = name, installed_version(name, folder)
        self._log = folder / f"{name}.log"
        with self._log.open("w") as log:
            self._process = subprocess.Popen(
                [str(python), "-m", PEERS[name].module, problem.to_json()],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=log,
                cwd=folder,
                env=environment,
                text=True,
            )

    def search_ms(self, dtype: str) -> float:
        """Milliseconds of one search, with the trunk of the model in `float32` or `bfloat16`.

        Raises:
            PeerError: The search failed; the message is the last line of the error.
        """
        assert self._process.stdin is not None and self._process.stdout is not None
        try:
            print(json.dumps({"dtype": dtype}), file=self._process.stdin, flush=True)
            answer = self._process.stdout.readline()
        except BrokenPipeError:
            answer = ""
        if not answer:
            self._process.wait()
            raise PeerError(
                last_line(self._log.read_text(errors="replace")) or "its process ended without an error message"
            )
        return float(json.loads(answer)["ms"])

    def close(self) -> None:
        """Ends the process."""
        self._process.kill()
        self._process.communicate()
