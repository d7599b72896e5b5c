"""`benchmark.py faults`: a run that is disturbed once a minute, and is only ever started again.

A toy run trains in a folder of its own, on a small file system in memory where the user may mount one. One fault
follows another in random order: kill -9 of the trainer and of its collection process, SIGTERM, a full disk, a flipped
bit in the newest save, a batch of NaN, an exception in the environment, and an environment that hangs. Whenever the
trainer has ended, the same command starts it again. After a quarter of the time the budget of frames is set to what the
rest of the time allows, and when the time is over no more faults happen. In the end the folder must hold the promised
frames, every evaluation that was due, and an agent that loads.
"""

from __future__ import annotations

import contextlib
import csv
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from bench.report import format_table, write_json
from bench.toy import EVERY_FRAMES, ROUND_FRAMES, find_worker, flip_bit
from latentplan.config.checks import above_zero
from latentplan.config.parsing import option

DISK_MEGABYTES = 192
DEAF_SECONDS = 120.0  # without a row of metrics, the trainer counts as hanging unnoticed
SETTLING_FRAMES = 60  # after which a run counts as going on: results of two rounds may be under way
CALIBRATING_SHARE = 0.25  # of the time, after which the budget of frames is set
CAUTION = 0.9  # share of the frames that the rate so far predicts
UNLIMITED_FRAMES = 10**8


@dataclass(frozen=True, kw_only=True)
class Request:
    """Flags of `benchmark.py faults`.

    Attributes:
        minutes: Minutes in which faults happen.
        every: Seconds between two faults.
        seed: Seed of the order and the times of the faults.
        log: Everything that the trainer and the faults said.
        json: Result as JSON.
    """

    minutes: float = 60.0
    every: float = 60.0
    seed: int = 0
    log: Path = Path("faults.log")
    json: Path | None = option(None, metavar="FILE", is_output=True)

    def __post_init__(self) -> None:
        above_zero(self, "minutes", "every")


@dataclass
class Tally:
    """Tries of one fault and what came of them.

    Attributes:
        tries: Times the fault was caused.
        survived: Times the run went on, by itself or after it was started again.
        starts: Starts that were needed.
        unnoticed: Times the trainer did nothing about it and had to be killed.
        exit_codes: Exit codes of trainers that ended.
    """

    tries: int = 0
    survived: int = 0
    starts: int = 0
    unnoticed: int = 0
    exit_codes: list[int] = field(default_factory=list)


def run(request: Request) -> int:
    """Disturbs a run until it has its frames, and prints what it survived."""
    rng = random.Random(request.seed)
    with contextlib.ExitStack() as stack:
        disk, is_small = stack.enter_context(_small_disk())
        log = stack.enter_context(request.log.open("w"))
        trainer = stack.enter_context(Trainer(disk, log))
        trainer.start()
        faults = dict(FAULTS)
        if not is_small:
            del faults["full disk"]
            print("no file system in memory can be mounted here: no full disk is tried", flush=True)
        tallies = {name: Tally() for name in faults}
        started = time.monotonic()
        order: list[str] = []
        while not trainer.is_complete() and (minutes := (time.monotonic() - started) / 60.0) < 2.0 * request.minutes:
            if trainer.frames == UNLIMITED_FRAMES and minutes >= CALIBRATING_SHARE * request.minutes:
                trainer.promise(60.0 * minutes, 60.0 * (request.minutes - minutes))
            trainer.wait(request.every * rng.uniform(0.5, 1.0))
            if trainer.is_complete() or minutes >= request.minutes:
                continue
            order = order or rng.sample(sorted(faults), len(faults))
            name = order.pop()
            disturb(trainer, name, faults[name], tallies[name], rng)
        checks = trainer.check()
        trainer.say(json.dumps(checks))
    result = {"minutes": (time.monotonic() - started) / 60.0, "promised_frames": trainer.frames, **checks}
    print(_format(tallies))
    print("\n".join(f"{name}: {value}" for name, value in result.items()))
    write_json(request.json, {**result, "faults": {name: vars(tally) for name, tally in tallies.items()}})
    return 0 if all(checks.values()) and all(tally.survived == tally.tries for tally in tallies.values()) else 1


class Trainer:
    """A trainer process that can be started again.

    Args:
        disk: Folder of the run folder.
        log: Receives what the trainer says.
    """

    def __init__(self, disk: Path, log: Any) -> None:
        self.disk, self.folder, self.log = disk, disk / "run", log
        self.triggers = Path(tempfile.mkdtemp(prefix="faults-"))
        self.frames = UNLIMITED_FRAMES
        self.process: subprocess.Popen[bytes] | None = None

    def __enter__(self) -> Trainer:
        return self

    def __exit__(self, *_: object) -> None:
        if self.process is not None and self.process.poll() is None:
            self.process.kill()
            self.process.wait()
        shutil.rmtree(self.triggers, ignore_errors=True)

    def say(self, line: str) -> None:
        """Write a line of the supervisor into the log and on the terminal."""
        text = f"[{time.strftime('%H:%M:%S')}] {line}"
        print(text, flush=True)
        print(text, file=self.log, flush=True)

    def start(self) -> None:
        """Start the same command again."""
        command = [sys.executable, "-m", "bench.faults_trainer", str(self.folder), str(self.frames), str(self.triggers)]
        scripts = Path(__file__).resolve().parent.parent
        paths = os.pathsep.join([str(scripts), str(scripts.parent)])
        environment = {**os.environ, "PYTHONPATH": paths, "OMP_NUM_THREADS": "1"}
        self.process = subprocess.Popen(command, stdout=self.log, stderr=self.log, env=environment)

    def stop(self, number: int) -> int:
        """Send a signal, and return the exit code as a shell counts it."""
        assert self.process is not None
        self.process.send_signal(number)
        return self.code(self.process.wait())

    def code(self, status: int) -> int:
        """The exit code of an ended process as a shell counts it."""
        return 128 - status if status < 0 else status

    def promise(self, seconds: float, left: float) -> None:
        """Set the budget of frames to what is likely to be reached in the time that is left, and start again with it.

        Args:
            seconds: Time since the first start, in which faults happened as often as they will happen.
            left: Time that is left.
        """
        self.stop(signal.SIGTERM)
        rate = self.clock() / seconds
        self.frames = self.clock() + max(1, int(CAUTION * rate * left / ROUND_FRAMES)) * ROUND_FRAMES
        self.say(f"{rate:.1f} frames per second so far: the run is promised {self.frames:,} frames")
        self.start()

    def clock(self) -> int:
        """Frames in the last row of metrics."""
        rows = self.rows()
        return int(rows[-1]["env_frames"]) if rows else 0

    def rows(self) -> list[dict[str, str]]:
        """The rows of metrics."""
        with contextlib.suppress(OSError), (self.folder / "metrics.csv").open(newline="") as file:
            return [row for row in csv.DictReader(file) if row.get("env_frames")]
        return []

    def is_complete(self) -> bool:
        """Whether the trainer has ended with its frames and its final evaluation."""
        return self.process is not None and self.process.poll() == 0

    def wait(self, seconds: float) -> None:
        """Let the trainer train; start it again if it has ended."""
        end = time.monotonic() + seconds
        while time.monotonic() < end and not self.is_complete():
            if self.process is not None and self.process.poll() is not None:
                self.say(f"the trainer has ended with {self.code(self.process.returncode)}: started again")
                self.start()
            time.sleep(0.2)

    def check(self) -> dict[str, bool]:
        """What the finished folder holds."""
        from latentplan.agents.checkpoint import load_agent

        rows = self.rows()
        evaluated = [int(row["env_frames"]) for row in rows if row["planner_return"]]
        updates = [int(row["updates"]) for row in rows if row["reconstruction"]]
        due = range(EVERY_FRAMES, self.frames - ROUND_FRAMES, EVERY_FRAMES)
        final = json.loads((self.folder / "final.json").read_text()) if self.is_complete() else {}
        for name in ("best", "last"):
            load_agent(self.folder / "checkpoints" / name)
        return {
            "has_promised_frames": final.get("env_frames") == self.frames,
            "has_final_evaluation": "planner" in final,
            "has_each_due_evaluation_once": [frames // EVERY_FRAMES for frames in evaluated if frames >= EVERY_FRAMES]
            == [frames // EVERY_FRAMES for frames in due],
            "has_each_epoch_once": updates == sorted(set(updates)),
        }


def disturb(
    trainer: Trainer, name: str, fault: Callable[[Trainer, random.Random], None], tally: Tally, rng: random.Random
) -> None:
    """Cause one fault, and wait until the run has gone on, started again where it has ended."""
    before, starts, code = trainer.clock(), 0, None
    trainer.say(f"fault: {name}, at {before:,} frames")
    tally.tries += 1
    fault(trainer, rng)
    since, seen = time.monotonic(), trainer.clock()
    while not trainer.is_complete():
        assert trainer.process is not None
        if (status := trainer.process.poll()) is not None:
            code = trainer.code(status)
            tally.exit_codes.append(code)
            starts += 1
            if starts > 5:
                trainer.say("the run does not go on")
                return
            trainer.start()
            since = time.monotonic()
        elif trainer.clock() > max(before, seen) + SETTLING_FRAMES:
            break
        elif time.monotonic() - since > DEAF_SECONDS:
            tally.unnoticed += 1
            trainer.stop(signal.SIGKILL)
        time.sleep(0.2)
    tally.survived += 1
    tally.starts += starts
    trainer.say(f"the run goes on after {starts} starts" + (f", exit code {code}" if code is not None else ""))


def kill_trainer(trainer: Trainer, rng: random.Random) -> None:
    """Kill -9 of the trainer."""
    trainer.stop(signal.SIGKILL)


def terminate(trainer: Trainer, rng: random.Random) -> None:
    """SIGTERM to the trainer."""
    trainer.stop(signal.SIGTERM)


def kill_worker(trainer: Trainer, rng: random.Random) -> None:
    """Kill -9 of the collection process."""
    assert trainer.process is not None
    with contextlib.suppress(OSError):
        if (worker := find_worker(trainer.process.pid)) is not None:
            os.kill(worker, signal.SIGKILL)


def corrupt(trainer: Trainer, rng: random.Random) -> None:
    """Kill the trainer and flip a bit of a file in the newest save."""
    trainer.stop(signal.SIGKILL)
    newest = max((trainer.folder / "resume").glob("save-*[0-9]"))
    path = rng.choice(sorted(newest.iterdir()))
    flip_bit(path, rng)
    trainer.say(f"flipped a bit of {newest.name}/{path.name}")


def fill_disk(trainer: Trainer, rng: random.Random) -> None:
    """Fill the disk until the trainer ends, and make room again."""
    filler = trainer.disk / "filler"
    with contextlib.suppress(OSError), filler.open("wb", buffering=0) as file:
        while True:
            file.write(bytes(65536))
    assert trainer.process is not None
    with contextlib.suppress(subprocess.TimeoutExpired):
        trainer.process.wait(DEAF_SECONDS)
    filler.unlink()


def _trigger(name: str) -> Callable[[Trainer, random.Random], None]:
    def fault(trainer: Trainer, rng: random.Random) -> None:
        (trainer.triggers / name).touch()
        end = time.monotonic() + DEAF_SECONDS
        while (trainer.triggers / name).exists() and time.monotonic() < end:
            time.sleep(0.05)

    return fault


FAULTS: dict[str, Callable[[Trainer, random.Random], None]] = {
    "kill -9 of the trainer": kill_trainer,
    "kill -9 of the worker": kill_worker,
    "SIGTERM": terminate,
    "full disk": fill_disk,
    "flipped bit in the newest save": corrupt,
    "batch of NaN": _trigger("nan"),
    "exception in the environment": _trigger("exception"),
    "environment that hangs": _trigger("hang"),
}


@contextlib.contextmanager
def _small_disk() -> Iterator[tuple[Path, bool]]:
    """A folder on a small file system of its own, and whether there is one."""
    folder = Path(tempfile.mkdtemp(prefix="faults-disk-"))
    size = f"size={DISK_MEGABYTES}m"
    command = ["mount", "-t", "tmpfs", "-o", size, "tmpfs", str(folder)]
    is_small = shutil.which("mount") is not None and subprocess.run(command, capture_output=True).returncode == 0
    try:
        yield folder, is_small
    finally:
        if is_small:
            subprocess.run(["umount", "--lazy", str(folder)], check=False)
        shutil.rmtree(folder, ignore_errors=True)


def _format(tallies: dict[str, Tally]) -> str:
    header = ["fault", "tries", "survived", "started again", "unnoticed", "exit codes"]
    rows = [
        [
            name,
            str(tally.tries),
            str(tally.survived),
            str(tally.starts),
            str(tally.unnoticed),
            " ".join(map(str, sorted(set(tally.exit_codes)))) or "-",
        ]
        for name, tally in tallies.items()
    ]
    return format_table(header, rows)
