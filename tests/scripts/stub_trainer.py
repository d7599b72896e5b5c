"""A stand-in for `train.py` that learns nothing: it counts frames, saves itself at each step and goes on from there.

A file `<run>.broken` beside the folder of a run makes the run fail. `processes.txt` in the folder has a line for every
process of the run: the flag that it was started with, and its number.
"""

import json
import os
import signal
import sys
import time
from pathlib import Path

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
    signal.signal(signal.SIGTERM, lambda number, _: stopped.append(number))
    with (folder / "processes.txt").open("a") as file:
        file.write(f"{words[0]} {os.getpid()}\n")
    frames = 0
    if "--resume" in flags:
        frames = int((save / "frames").read_text())
    else:
        assert not save.exists(), "a run that was begun is begun again"
        save.mkdir(parents=True)
        (save / "frames").write_text("0")
        metrics.write_text(HEADER + "\n")
    lines = metrics.read_text().splitlines()[: 1 + 2 * (frames // STEP)]
    while frames < int(flags["--frames"]):
        time.sleep(PAUSE_S)
        if stopped:
            return 128 + stopped[0]
        frames += STEP
        clocks = f"{frames},{frames // 2},{frames / 10}"
        lines += [f"{clocks},,,0.5", f"{clocks},{frames * 1.5},{frames * 1.25},"]
        metrics.write_text("\n".join(lines) + "\n")
        part = save / "frames.part"
        part.write_text(str(frames))
        part.replace(save / "frames")
    final = {"env_frames": frames, "updates": frames // 2, "minutes": frames / 10, "planner": 7.0, "actor": 5.0}
    (folder / "final.json").write_text(json.dumps(final))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
