"""`benchmark.py view`: decisions per second that the live view holds while a page is open in headless Chromium.

The benchmark starts `latentplan view` as a program of its own, opens its page, and listens beside the page to the
messages that the page gets. `make test-browser` installs what it needs.
"""

from __future__ import annotations

import contextlib
import json
import os
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bench.report import format_number, format_table, write_json
from latentplan.config import UserError
from latentplan.config.checks import above_zero
from latentplan.config.extras import require_extra
from latentplan.config.parsing import option

ROOT = Path(__file__).resolve().parents[2]
CHROMIUM = ("chromium", "chromium-browser", "google-chrome")
WARM_UP_S = 5.0
PAGE_MS = 120_000


@dataclass(frozen=True)
class Request:
    """Flags of `benchmark.py view`.

    Attributes:
        checkpoint: Folder of a trained agent.
        control_hz: Decisions per second that are asked for.
        seconds: Seconds that are measured.
        mode: Agent that chooses the actions.
        objective: Objective in place of the task.
        json: Result as JSON.
    """

    checkpoint: Path = option(Path("checkpoints/walker-walk"), metavar="DIR")
    control_hz: float = 25.0
    seconds: float = 30.0
    mode: str = "planner"
    objective: str | None = None
    json: Path | None = option(None, metavar="FILE", is_output=True)

    def __post_init__(self) -> None:
        above_zero(self, "control_hz", "seconds")


def run(request: Request) -> int:
    """Measures the rate, and prints and writes it.

    Raises:
        UserError: The live view refuses its flags.
        MissingExtra: A library is not installed.
    """
    require_extra("benchmark.py view", "playwright", "websockets")
    goal = () if request.objective is None else ("--objective", request.objective)
    flags = ["--checkpoint", str(request.checkpoint), "--mode", request.mode, *goal]
    flags += ["--control-hz", str(request.control_hz), "--port", "0"]
    with _serving(flags) as address, _watched(address):
        time.sleep(WARM_UP_S)
        load, moments = os.getloadavg()[0], listen(address, request.seconds)
    result = summarize(moments) | {"control_hz": request.control_hz, "load": load, "cores": os.cpu_count()}
    rows = [[name.replace("_", " "), format_number(value, 1)] for name, value in result.items()]
    print(format_table([f"{request.checkpoint}, {request.mode}", ""], rows))
    write_json(request.json, {"checkpoint": str(request.checkpoint), "mode": request.mode, **result})
    return 0


def listen(address: str, seconds: float) -> list[dict[str, Any]]:
    """The moments that a page gets in some seconds, each with the time `at` of its arrival.

    Args:
        address: Address of the live view.
        seconds: Seconds to listen.
    """
    from websockets.sync.client import connect
    from websockets.typing import Origin

    host, moments, end = address.removeprefix("http://").rstrip("/"), [], time.perf_counter() + seconds
    with connect(f"ws://{host}/live", origin=Origin(f"http://{host}")) as socket:
        while time.perf_counter() < end:
            message = json.loads(socket.recv(timeout=60.0))
            if "moment" in message:
                moments.append({**message["moment"], "at": time.perf_counter()})
    return moments


def summarize(moments: Sequence[dict[str, Any]]) -> dict[str, float]:
    """Decisions per second, share of late ones, and quantiles of the milliseconds of decisions and of whole periods.

    Raises:
        UserError: The moments are not of two decisions.
    """
    import numpy as np

    if not moments or moments[0]["number"] == moments[-1]["number"]:
        raise UserError("no two decisions within --seconds; give more --seconds or a higher --control-hz")
    first, last = moments[0], moments[-1]
    num = last["number"] - first["number"]
    quantiles = {
        f"{name}_p{quantile}": float(np.percentile([moment[name] for moment in moments], quantile))
        for name in ("decision_ms", "busy_ms")
        for quantile in (50, 95)
    }
    late = 100.0 * (last["late"] - first["late"]) / num
    return {"decisions_per_second": num / (last["at"] - first["at"]), "late_percent": late, **quantiles}


@contextlib.contextmanager
def _serving(flags: Sequence[str]) -> Iterator[str]:
    """A live view in a program of its own; its address."""
    command = [sys.executable, "-m", "latentplan", "view", *flags]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    with subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        try:
            found = re.search(r"http://\S+", process.stdout.readline() + process.stdout.readline())
            if found is None:
                raise UserError("the live view did not start")
            yield found[0]
        finally:
            process.terminate()
            process.wait()


@contextlib.contextmanager
def _watched(address: str) -> Iterator[None]:
    """The page of the live view, open in headless Chromium with its charts drawn."""
    from playwright.sync_api import sync_playwright

    found = next((path for path in map(shutil.which, CHROMIUM) if path), None)
    sandbox = ["--no-sandbox"] if os.getuid() == 0 else []  # Chromium refuses its sandbox to root
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=found, args=sandbox)
        page = browser.new_page(viewport={"width": 1400, "height": 900})
        page.goto(address, timeout=PAGE_MS)
        page.wait_for_selector("#latency .main-svg >> nth=0", timeout=PAGE_MS)
        yield
        browser.close()
