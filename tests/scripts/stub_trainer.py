"""A stand-in for `train.py` that learns nothing: it counts frames, saves itself at each step and goes on from there.

A file `<run>.broken` beside the folder of a run makes the run fail; with a file `<run>.held` the run waits before its
last step until it is told to stop. `processes.txt` in the folder has a line for every process of the run: the flag that
it was started with, and its number.
"""

import json
import os
import signal
import sys
import time
from pathlib import Path

from latentplan.config.writing import write_whole

STEP, PAUSE_S = 20, 0.02
HEADER = "env_frames,updates,minutes,planner_return,actor_return,actor"  # the last is a loss


def main(words):
    flags = dict(zip(words[::2], words[1::2], strict=True))
    folder = Path(flags.get("--run-dir") or flags["--resume"])
    save, metrics = folder / "resume" / "save-000001", folder / "metrics.csv"
    if Path(f"{folder}.broken").exists():
        print("preparing\nerror: this run is broken")
        return 2
    stopped = []
    for ending in (signal.SIGTERM, signal.SIGHUP):  # of the sweep, and of the system where the sweep was killed
        signal.signal(ending, lambda number, _: stopped.append(number))
    with (folder / "processes.txt").open("a") as file:
        file.write(f"{words[0]} {os.getpid()}\n")
    frames = 0
    if "--resume" in flags:
        frames = int((save / "frames").read_text())
    else:
        assert not save.exists(), "a run that was begun is begun again"
        save.mkdir(parents=True)
        write_whole(metrics, HEADER + "\n")
        write_whole(save / "frames", "0")
    lines = metrics.read_text().splitlines()[: 1 + 2 * (frames // STEP)]
    while frames < int(flags["--frames"]):
        time.sleep(PAUSE_S)
        is_last = frames + STEP >= int(flags["--frames"])
        while is_last and not stopped and Path(f"{folder}.held").exists():
            time.sleep(PAUSE_S)
        if stopped:
            return 128 + stopped[0]
        frames += STEP
        clocks = f"{frames},{frames // 2},{frames / 10}"
        lines += [f"{clocks},,,0.5", f"{clocks},{frames * 1.5},{frames * 1.25},"]
        write_whole(metrics, "\n".join(lines) + "\n")
        write_whole(save / "frames", str(frames))
    final = {"env_frames": frames, "updates": frames // 2, "minutes": frames / 10, "planner": 7.0, "actor": 5.0}
    write_whole(folder / "final.json", json.dumps(final))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
