"""A stand-in for `latentplan train` that learns nothing: its return is the horizon times the frames."""

import json
import signal
import sys
import time
from pathlib import Path

import yaml

FRAMES, STEP = 90, 10


def main(words):
    flags = dict(zip(words[::2], words[1::2], strict=True))
    folder = Path(flags.get("--run-dir") or flags["--resume"])
    save, copy = folder / "resume" / "save-000001", folder / "config.yaml"
    stopped = []
    signal.signal(signal.SIGTERM, lambda number, _: stopped.append(number))
    with (folder / "processes.txt").open("a") as file:
        file.write(words[0] + "\n")
    if "--resume" not in flags:
        save.mkdir(parents=True)
        copy.write_text(Path(flags["--config"]).read_text())
    horizon = yaml.safe_load(copy.read_text())["planner"]["horizon"]
    if (folder.parent / "broken").exists():
        print("error: this run is broken")
        return 2
    saved = save / "frames"
    frames = int(saved.read_text()) if saved.exists() else 0
    lines = ["env_frames,updates,minutes,planner_return,actor_return"]
    lines += [f"{count},1,0.1,{horizon * count},1" for count in range(STEP, frames + 1, STEP)]
    while frames < FRAMES:
        time.sleep(0.1)
        if stopped:
            with (folder / "processes.txt").open("a") as file:
                file.write("saved\n")
            return 143
        frames += STEP
        lines.append(f"{frames},1,0.1,{horizon * frames},1")
        (folder / "metrics.csv").write_text("\n".join(lines) + "\n")
        saved.write_text(str(frames))
    clocks = {"env_frames": frames, "minutes": 0.1, "updates": 1}
    (folder / "final.json").write_text(json.dumps(clocks | {"planner": horizon * frames, "actor": 1.0}))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
