"""The replay on disk: frames in append-only logs, and everything else of the rows in one file per save.

Where several processes learn together, each has a replay and writes a file and logs of its own; `dealing` gives the
rows of all of them to another number of processes.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from latentplan.config import UserError
from latentplan.config.commit import Log, Save, Saves
from latentplan.config.manifest import DamageError, Extent
from latentplan.replay.buffer import COLUMNS, Replay, read_saved, write_saved

ROWS_FILE = "rows.pt"
FORMAT = 1
ROWS_PER_BLOCK = 256


def rows_file(rank: int) -> str:
    """Name of the file with the rows of one process: `rows.pt` for process 0, or where there is only one."""
    return f"rows-{rank}.pt" if rank else ROWS_FILE


def log_name(rank: int, lane: int) -> str:
    """Name of the log with the frames of one lane of a process."""
    return f"rank{rank}-frames{lane}" if rank else f"frames{lane}"


class ReplayFiles:
    """Writes the rows of a replay for a save, and reads them back.

    Frames never change once they were collected, so a save appends those that are new. The other columns are written
    whole, because updates refresh the beliefs of any rows; they take a small part of the room that frames take.

    Args:
        folder: Folder of all saves.
        replay: The replay.
        rank: Number of the process that the replay belongs to.
    """

    def __init__(self, folder: Path, replay: Replay, rank: int = 0) -> None:
        self.folder, self.replay, self.rank = folder, replay, rank
        row_bytes = replay.frames[0].numel()
        self._logs = [Log(folder, log_name(rank, lane), row_bytes) for lane in range(replay.num_lanes)]

    def write(self, part: Path) -> dict[str, Extent]:
        """Appends new frames, and writes the other columns into the folder of a save.

        Frames whose log another program has changed are written again, and a warning names the log.

        Returns:
            The committed part of each log.
        """
        replay = self.replay
        extents: dict[str, Extent] = {}
        for lane, log in enumerate(self._logs):
            first, end = int(replay.first[lane]), int(replay.written[lane])
            if (changed := log.forget_changed()) is not None:
                warnings.warn(
                    f"{changed} was changed by another program: its frames are written again",
                    RuntimeWarning,
                    stacklevel=2,
                )
            if (start := max(first, log.end)) < end:
                log.append(start, self._blocks(lane, start, end))
            log.drop_before(first)
            extents |= log.extents()
        index = torch.cat([replay.held_rows(lane) for lane in range(replay.num_lanes)])
        columns = {name: getattr(replay, name)[index].cpu() for name in COLUMNS}
        episode = torch.from_numpy(replay.episode)[index.cpu()]
        bounds = {name: torch.from_numpy(getattr(replay, name).copy()) for name in ("first", "written")}
        recorded = {"num_recorded": replay.num_recorded} if replay.num_recorded else {}
        write_saved(columns | bounds | {"episode": episode} | recorded, part / rows_file(self.rank))
        return extents

    def read(self, save: Save) -> None:
        """Fills the replay with the rows of a save, or with the newest that fit.

        Raises:
            UserError: The lanes, actions, beliefs or labels of the save have other sizes.
        """
        replay = self.replay
        saved = read_rows(save, self.rank)
        check_sizes(saved, replay, save)
        offset = 0
        for lane, (first, end) in enumerate(zip(saved["first"].tolist(), saved["written"].tolist(), strict=True)):
            held = min(end - first, int(replay.sizes[lane]))
            rows = slice(offset + end - first - held, offset + end - first)
            offset += end - first
            replay.first[lane], replay.written[lane] = end - held, end
            numbers = np.arange(end - held, end)
            places = replay.places(lane, numbers)
            replay.episode[places] = saved["episode"][rows].numpy()
            self._logs[lane].restore(save.logs)
            copy_rows(replay, places, saved, rows, self._logs[lane], numbers)

    def _blocks(self, lane: int, start: int, end: int) -> Iterator[bytes]:
        replay = self.replay
        for first in range(start, end, ROWS_PER_BLOCK):
            rows = replay.places(lane, np.arange(first, min(first + ROWS_PER_BLOCK, end)))
            yield replay.frames[torch.as_tensor(rows, device=replay.device)].cpu().numpy().tobytes()


def read_rows(save: Save, rank: int) -> dict[str, Any]:
    """The rows that one process saved, but their frames.

    Raises:
        DamageError: The file is damaged, or its parts do not fit each other.
    """
    path = save.folder / rows_file(rank)
    kinds = dict.fromkeys((*COLUMNS, "episode", "first", "written"), torch.Tensor)
    saved: dict[str, Any] = read_saved(path, keys=kinds)
    whole = ("episode", "first", "written")
    dims = dict.fromkeys(kinds, 1) | dict.fromkeys(("deter", "actions", "labels"), 2)
    for name, value in ((name, saved[name]) for name in kinds):
        is_right = value.dtype == torch.int64 if name in whole else value.is_floating_point()
        if not is_right or value.ndim != dims[name]:
            raise DamageError(f"{path} is damaged: {name} has another form")
    first, written, recorded = saved["first"], saved["written"], saved.get("num_recorded", 0)
    if first.shape != written.shape or not bool(((first >= 0) & (first <= written)).all()):
        raise DamageError(f"{path} is damaged: the numbers of its rows are not in order")
    rows = (written - first).tolist()
    if any(len(saved[name]) != sum(rows) for name in (*COLUMNS, "episode")):
        raise DamageError(f"{path} is damaged: its columns must have {sum(rows):,} rows")
    if type(recorded) is not int or recorded < 0 or len(rows) <= (recorded > 0) or (recorded and rows[-1] > recorded):
        raise DamageError(f"{path} is damaged: num_recorded has another form")
    return saved


def check_sizes(saved: Mapping[str, Any], replay: Replay, save: Save) -> None:
    """Refuse saved rows that do not fit a replay.

    Raises:
        UserError: The lanes, actions, beliefs or labels of the save have other sizes.
    """
    columns = ("actions", "deter", "labels")
    sizes = (len(saved["written"]), *(saved[name].shape[1] for name in columns))
    own = (replay.num_lanes, *(getattr(replay, name).shape[1] for name in columns))
    if sizes != own:
        raise UserError(
            f"the replay in {save.folder} has (environments, action, deter, labels) {sizes}, this run {own}"
        )


def copy_rows(
    replay: Replay, places: np.ndarray, saved: Mapping[str, Any], rows: slice, log: Log, numbers: np.ndarray
) -> None:
    """Copies saved rows, and their frames from a log, into a replay.

    Args:
        replay: The replay.
        places: Rows of the replay to copy to, int64 (n,).
        saved: What `read_rows` returned.
        rows: Its rows to copy, n of them.
        log: The log.
        numbers: Rows of the log with the frames, ascending, int64 (n,).

    Raises:
        UserError: The log lacks frames.
    """
    index = torch.as_tensor(places, device=replay.device)
    replay.is_end[places] = saved["continues"][rows].numpy() == 0.0
    for name in COLUMNS:
        getattr(replay, name)[index] = saved[name][rows].to(replay.device)
    found = 0
    for first, count, path in log.rows():
        low, high = np.searchsorted(numbers, (first, first + count))
        if low >= high:
            continue
        stored = np.memmap(path, np.uint8, "r", shape=(count, *replay.frames.shape[1:]))
        replay.frames[index[low:high]] = torch.from_numpy(stored[numbers[low:high] - first]).to(replay.device)
        found += high - low
    if found != len(numbers):
        raise UserError(f"the logs in {log.folder} are damaged: they must hold {len(numbers):,} frames")


def save_replay(replay: Replay, folder: Path, note: Mapping[str, Any]) -> None:
    """Saves a replay alone; `load_replay` restores it."""
    Saves(folder, "replay", FORMAT).commit(ReplayFiles(folder, replay).write, note)


class Counts(NamedTuple):
    """What a saved replay holds.

    Attributes:
        num_lanes: Environments.
        lane_rows: The largest number of rows of one of them.
        recorded_rows: Rows of episodes that were recorded before the run; 0 without any.
    """

    num_lanes: int
    lane_rows: int
    recorded_rows: int


def count_saved(save: Save, rank: int = 0) -> Counts:
    """What the saved replay of one process holds, without its frames.

    Raises:
        DamageError: The file is damaged, or its parts do not fit each other.
    """
    saved = read_rows(save, rank)
    recorded: int = saved.get("num_recorded", 0)  # saves of earlier versions lack it
    rows = (saved["written"] - saved["first"]).tolist()
    lanes = rows[:-1] if recorded else rows
    return Counts(len(lanes), max(lanes), recorded)
