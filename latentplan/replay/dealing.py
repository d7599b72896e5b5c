"""Deals the rows that some processes have saved to another number of processes.

Episodes stay whole, but for those that are longer than a fair share of their lane: these are cut. A piece begins with
the belief that its first row holds, as any drawn sequence does.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from latentplan.config.commit import Log, Save
from latentplan.replay.buffer import Replay
from latentplan.replay.disk import Counts, check_sizes, copy_rows, log_name, read_rows, rows_file


class Piece(NamedTuple):
    """Consecutive saved rows of one episode.

    Attributes:
        age: Rows of its lane from the first row of the piece on; larger for older pieces.
        rank: Process that saved them.
        start: Number of the first row in its lane.
        length: Number of rows.
        offset: Place of the first row among all rows that the process saved.
    """

    age: int
    rank: int
    start: int
    length: int
    offset: int


class DealtRows:
    """The share of one process of all rows in a save, about as many as the others get, from the same times.

    Args:
        save: The save.
        rank: Number of the process.
        size: Processes that share the rows.

    Attributes:
        counts: What the share holds.

    Raises:
        UserError: A file of the save is damaged.
    """

    def __init__(self, save: Save, rank: int, size: int) -> None:
        self.save = save
        self._saved = [read_rows(save, saved) for saved in range(count_ranks(save))]
        num_lanes = len(self._saved[0]["written"])
        self._pieces = [self._deal(lane, size)[rank] for lane in range(num_lanes)]  # of each lane, the oldest first
        rows = [sum(piece.length for piece in pieces) for pieces in self._pieces]
        recorded = rows.pop() if "num_recorded" in self._saved[0] else 0
        self.counts = Counts(len(rows), max(rows), recorded)

    def fill(self, replay: Replay) -> None:
        """Fills a replay with the rows of the share, or with the newest that fit.

        Rows get numbers above all saved ones, so that no log of the save is written again.

        Raises:
            UserError: The rows do not fit the replay, or a log lacks frames.
        """
        for saved in self._saved:
            check_sizes(saved, replay, self.save)
        for lane, pieces in enumerate(self._pieces):
            number = max(int(saved["written"][lane]) for saved in self._saved)
            replay.written[lane] = number + sum(piece.length for piece in pieces)
            replay.first[lane] = max(number, replay.written[lane] - replay.sizes[lane])
            for episode, piece in enumerate(pieces):
                self._copy(replay, lane, piece, episode, number)
                number += piece.length

    def _copy(self, replay: Replay, lane: int, piece: Piece, episode: int, number: int) -> None:
        """Copies a piece to the rows of a lane from `number` on, but for rows that no longer fit."""
        skipped = max(0, int(replay.first[lane]) - number)
        if skipped >= piece.length:
            return
        places = replay.places(lane, np.arange(number + skipped, number + piece.length))
        replay.episode[places] = episode
        log = Log(self.save.folder.parent, log_name(piece.rank, lane), replay.frames[0].numel())
        log.restore(self.save.logs)
        rows = slice(piece.offset + skipped, piece.offset + piece.length)
        numbers = np.arange(piece.start + skipped, piece.start + piece.length)
        copy_rows(replay, places, self._saved[piece.rank], rows, log, numbers)

    def _deal(self, lane: int, size: int) -> list[list[Piece]]:
        """The pieces of a lane for each process, the oldest first: the next one goes to whom has fewest rows so far."""
        total = sum(int(saved["written"][lane] - saved["first"][lane]) for saved in self._saved)
        longest = max(1, -(-total // size))
        pieces = [piece for rank in range(len(self._saved)) for piece in self._cut(rank, lane, longest)]
        shares: list[list[Piece]] = [[] for _ in range(size)]
        rows = [0] * size
        for piece in sorted(pieces, key=lambda piece: (-piece.age, piece.rank)):
            chosen = rows.index(min(rows))
            shares[chosen].append(piece)
            rows[chosen] += piece.length
        return shares

    def _cut(self, rank: int, lane: int, longest: int) -> list[Piece]:
        """The episodes of a lane that one process saved, in pieces of at most `longest` rows."""
        saved = self._saved[rank]
        counts = (saved["written"] - saved["first"]).tolist()
        offset, first, end = sum(counts[:lane]), int(saved["first"][lane]), int(saved["written"][lane])
        episode = saved["episode"][offset : offset + counts[lane]].numpy()
        starts = np.flatnonzero(np.diff(episode, prepend=-1) != 0)
        pieces = []
        for start, stop in zip(starts, [*starts[1:], len(episode)], strict=True):
            for place in range(int(start), int(stop), longest):
                count = min(longest, int(stop) - place)
                pieces.append(Piece(end - first - place, rank, first + place, count, offset + place))
        return pieces


def count_ranks(save: Save) -> int:
    """The number of processes whose rows a save holds."""
    rank = 1
    while (save.folder / rows_file(rank)).exists():
        rank += 1
    return rank
