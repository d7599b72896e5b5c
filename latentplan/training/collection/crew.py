"""Crew: several workers that share every round and every evaluation, behind the interface of one worker."""

from __future__ import annotations

import warnings
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED
from concurrent.futures import wait as wait_for
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import torch

from latentplan.config import CollectionConfig, Config, EnvironmentFault, UserError
from latentplan.config.manifest import DamageError
from latentplan.config.run_folder import RUN_FILE
from latentplan.replay.buffer import Rows
from latentplan.training.cluster import join_cluster
from latentplan.training.collection.collector import Collected, EnvFactory
from latentplan.training.collection.episodes import Stopped
from latentplan.training.collection.process import POLL_SECONDS, LocalWorker, PatientWorker, RemoteWorker, WorkerEnded
from latentplan.training.collection.ray_workers import RayWorker
from latentplan.training.resources import choose_collector_threads

WORKER_RESTARTS = 20  # collection processes that may end between two starts of a run before the run does

UNANSWERED = ("restore", "notice_end")  # requests whose answers nobody waits for


class Crew:
    """Divides the requests of a run among workers, and joins their answers in the order of the workers' numbers.

    Every worker collects its share of a round in environments of its own, and continues its own episodes. Episode i of
    an evaluation is played by worker i modulo their number. A worker that ended is replaced, and repeats its requests:
    a `RemoteWorker` first repeats its running episodes, a `RayWorker` begins new ones, which counts as a restart of its
    environments.

    With `collection.asynchronous` a worker that has delivered its share begins the next one at once, until the round
    has enough decisions; shares that arrive later belong to the next round.

    Args:
        workers: The workers, by number.
        settings: Settings of collection.
        should_stop: Whether the run stops, so that nobody waits for results.

    Attributes:
        replaced: Workers that ended and were replaced.
    """

    def __init__(
        self,
        workers: Sequence[RemoteWorker | RayWorker],
        settings: CollectionConfig,
        should_stop: Callable[[], bool] = lambda: False,
    ) -> None:
        self.members = [_Member(worker) for worker in workers]
        self.replaced = 0
        self._settings, self._should_stop = settings, should_stop
        self._requests: deque[Callable[[], Any]] = deque()  # each returns a result
        self._early: list[tuple[int, Collected]] = []  # shares that no round has counted yet
        self._has_seen_end = False

    def submit(self, method: str, *arguments: Any) -> None:
        """Ask for the result of a method of `Collector`; `result` returns the results in the order of the requests."""
        divided: dict[str, Callable[..., Callable[[], Any]]] = {
            "collect": self._submit_round,
            "evaluate": self._submit_evaluation,
            "restore": self._restore,
            "notice_end": self._notice_end,
        }
        if method in divided:
            self._requests.append(divided[method](*arguments))
            return
        self.members[0].ask(method, *arguments)
        self._requests.append(lambda: self._answer(0, method))

    def result(self) -> Any:
        """The oldest result that was not returned before; waits until it is there.

        Raises:
            UserError: The method raised this error.
            EnvironmentFault: The environments of a worker, or a Ray worker itself, had to be replaced too often.
            Stopped: The run stops.
            WorkerEnded: Too many processes ended since the run was started or resumed.
            RuntimeError: The method failed with another error.
        """
        return self._requests.popleft()()

    def close(self) -> None:
        """Ends all workers."""
        for member in self.members:
            member.worker.close()

    def _submit_round(
        self,
        weights: dict[str, np.ndarray] | None,
        behaviour: str,
        decisions: int,
        counter: int,
        goal: str | None = None,
    ) -> Callable[[], Collected]:
        share = -(-decisions // len(self.members))
        words = (self._publish(weights), behaviour, share)
        if weights is not None and self._settings.asynchronous:
            for member in self.members:
                if not member.is_collecting:
                    member.ask_share(words, goal)
            return lambda: self._join_first(words, goal, decisions)
        for member in self.members:
            member.ask("collect", *words, counter, goal)
        return lambda: self._join([(number, self._answer(number, "collect")) for number in range(len(self.members))])

    def _submit_evaluation(
        self,
        episodes: int,
        film: Path | None = None,
        weights: dict[str, np.ndarray] | None = None,
        actor: bool = True,
        record: bool = False,
    ) -> Callable[[], dict[str, list[float]]]:
        size = min(len(self.members), episodes)
        film = film and film.absolute()  # actors start in another folder
        published = self._publish(weights)
        for number, member in enumerate(self.members[:size]):
            watched = (None, published, actor, False) if number else (film, published, actor, record)
            member.ask("evaluate", episodes, *watched, number, size)

        def join() -> dict[str, list[float]]:
            played = [self._answer(number, "evaluate") for number in range(size)]
            return {
                mode: [played[index % size][mode][index // size] for index in range(episodes)] for mode in played[0]
            }

        return join

    def _restore(self, memory: dict[str, Any]) -> Callable[[], None]:
        for member, own, ended, shares in zip(
            self.members, memory["members"], memory["ended"], memory["shares"], strict=True
        ):
            member.memory = member.stored = own
            member.ended, member.shares = ended, shares
            if own is not None:
                member.ask("restore", own)
        if memory["has_seen_end"]:
            self._notice_end()
        return lambda: None

    def _notice_end(self) -> Callable[[], None]:
        self._has_seen_end = True
        for member in self.members:
            member.ask("notice_end")
        return lambda: None

    def _publish(self, weights: dict[str, np.ndarray] | None) -> Any:
        """The weights in the form in which all workers take them."""
        return None if weights is None else self.members[0].worker.publish(weights)

    def _join(self, shares: list[tuple[int, Collected]]) -> Collected:
        """One round of shares, each with the number of its worker, whose shares are in the order of time."""
        for number, share in shares:
            self.members[number].stored = share.memory
        members = self.members
        lanes = len(shares[0][1].rows)
        nothing = Rows(**{f.name: getattr(shares[0][1].rows[0], f.name)[:0] for f in fields(Rows)})
        rows = [
            _concatenate([share.rows[lane] for by, share in shares if by == number] or [nothing])
            for number in range(len(members))
            for lane in range(lanes)
        ]
        memories = [member.stored for member in members]
        known = [memory for memory in memories if memory is not None]
        has_seen_end = self._has_seen_end or any(memory["has_seen_end"] for memory in known)
        if has_seen_end and not self._has_seen_end:
            self._notice_end()
        lost = sum(member.ended for member in members)
        return Collected(
            rows=rows,
            env_frames=sum(share.env_frames for _, share in shares),
            decisions=sum(share.decisions for _, share in shares),
            episode_returns=[value for _, share in shares for value in share.episode_returns],
            memory={
                "restarts": sum(memory["restarts"] for memory in known) + lost,
                "has_seen_end": has_seen_end,
                "members": memories,
                "ended": [member.ended for member in members],
                "shares": [member.shares for member in members],
            },
            fault=next((share.fault for _, share in shares if share.fault is not None), None),
        )

    def _join_first(self, words: tuple[Any, ...], goal: str | None, decisions: int) -> Collected:
        """A round of the shares that arrive first; of a share that is late, the next round makes use."""
        found, self._early = self._early, []
        while sum(share.decisions for _, share in found) < decisions:
            number = self._await_share()
            share = self._answer(number, "collect")
            found.append((number, share))
            if share.fault is not None:
                break
            if sum(share.decisions for _, share in found) < decisions:
                self.members[number].ask_share(words, goal)
        return self._join(found)

    def _await_share(self) -> int:
        """Number of a worker whose next share has arrived."""
        while True:
            heads = {member.worker.oldest: number for number, member in enumerate(self.members) if member.is_collecting}
            done, _ = wait_for(heads, timeout=POLL_SECONDS, return_when=FIRST_COMPLETED)
            if self._should_stop():
                raise Stopped
            for number in sorted(heads[future] for future in done):
                if self.members[number].waiting[0][0] == "collect":
                    return number
                self._keep(number, *self._take(number))

    def _answer(self, number: int, wanted: str) -> Any:
        """The answer of one worker to its oldest request of a method."""
        kept = self.members[number].kept
        for place, (method, answer) in enumerate(kept):
            if method == wanted:
                del kept[place]
                return answer
        while True:
            method, answer = self._take(number)
            if method == wanted:
                return answer
            self._keep(number, method, answer)

    def _keep(self, number: int, method: str, answer: Any) -> None:
        """Keeps an answer that somebody asks for later; nobody asks for those to `restore` and `notice_end`."""
        if method == "collect":
            self._early.append((number, answer))
        elif method not in UNANSWERED:
            self.members[number].kept.append((method, answer))

    def _take(self, number: int) -> tuple[str, Any]:
        """The oldest request of one worker, and its answer."""
        member = self.members[number]
        while True:
            try:
                answer = member.worker.result()
                break
            except WorkerEnded as error:
                self._replace(number, error)
        method, _ = member.waiting.popleft()
        if method == "collect":
            member.memory = answer.memory
        return method, answer

    def _replace(self, number: int, error: WorkerEnded) -> None:
        """Starts a new worker in place of one that ended, and repeats its requests."""
        member = self.members[number]
        self.replaced += 1
        if member.worker.repeats_episodes:
            if self.replaced > WORKER_RESTARTS:
                raise error
            rest, count, limit = "repeats its round", self.replaced, WORKER_RESTARTS
        else:
            count, limit = member.restarts + 1, self._settings.max_restarts
            if count > limit:
                raise EnvironmentFault(f"{error} after {count - 1} restarts (collection.max_restarts {limit})")
            member.ended += 1
            member.memory = None if member.memory is None else end_episodes(member.memory)
            rest = "its episode is cut short"
        warnings.warn(
            f"worker {number}: {error}: it is started again ({count} of {limit} times), and {rest}",
            RuntimeWarning,
            stacklevel=2,
        )
        waiting = [request for request in member.waiting if request[0] not in UNANSWERED]
        member.worker.restart()
        member.waiting.clear()
        if self._has_seen_end:
            member.ask("notice_end")
        if member.memory is not None:
            member.ask("restore", member.memory)
        for method, arguments in waiting:
            member.ask(method, *arguments)


class _Member:
    """A worker of a crew, and what it was asked for.

    Attributes:
        waiting: Requests without an answer, in order.
        kept: Answers that arrived before somebody asked for them, each with its method.
        memory: State of its collector after its latest share; None before the first.
        stored: State of its collector after its latest share that a round has counted.
        ended: Workers of this number that ended and took their episodes with them.
        shares: Shares so far that the worker was asked for out of the order of rounds.
    """

    def __init__(self, worker: RemoteWorker | RayWorker) -> None:
        self.worker = worker
        self.waiting: deque[tuple[str, tuple[Any, ...]]] = deque()
        self.kept: list[tuple[str, Any]] = []
        self.memory: dict[str, Any] | None = None
        self.stored: dict[str, Any] | None = None
        self.ended = self.shares = 0

    @property
    def is_collecting(self) -> bool:
        """Whether a share was asked for and has not arrived."""
        return any(method == "collect" for method, _ in self.waiting)

    @property
    def restarts(self) -> int:
        """Restarts of the worker's environments so far, and of the worker itself where these cost episodes."""
        return self.ended + (0 if self.memory is None else int(self.memory["restarts"]))

    def ask(self, method: str, *arguments: Any) -> None:
        """Make a request."""
        self.waiting.append((method, arguments))
        self.worker.submit(method, *arguments)

    def ask_share(self, words: tuple[Any, ...], goal: str | None) -> None:
        """Ask for a share with random streams of its own, whatever round it will belong to."""
        self.shares += 1
        self.ask("collect", *words, self.shares, goal)


Worker = LocalWorker | RemoteWorker | Crew


def make_worker(
    config: Config, make_user_env: EnvFactory | None, device: torch.device, should_stop: Callable[[], bool]
) -> Worker:
    """The worker that the settings of collection select; a local worker acts on the learner's device."""
    collection = config.collection
    if not collection.overlap:
        kind = LocalWorker if config.run.num_ranks == 1 else PatientWorker
        return kind(config, make_user_env, str(device), should_stop)
    threads = choose_collector_threads(device, collection.workers)
    if _is_alone(collection):
        return RemoteWorker(config, make_user_env, threads, should_stop)
    if collection.backend == "ray":
        join_cluster(config.run.ray_address, collection.workers)
    start: type[RemoteWorker | RayWorker] = RayWorker if collection.backend == "ray" else RemoteWorker
    workers: list[RemoteWorker | RayWorker] = []
    try:
        for number in range(collection.workers):
            workers.append(start(config, make_user_env, threads, should_stop, number))
    except BaseException:
        for worker in workers:
            worker.close()
        raise
    return Crew(workers, collection, should_stop)


def check_memory(memory: dict[str, Any] | None, config: Config, folder: Path) -> None:
    """Refuses running episodes of other workers or environments than the settings have.

    Args:
        memory: `Collected.memory` of the last save; None before the first round.
        config: Settings of the run, which a user may have edited since.
        folder: Folder of the run, for the error message.

    Raises:
        UserError: The episodes cannot go on with these settings.
        DamageError: The parts of the state do not fit each other.
    """
    if memory is None:
        return
    is_crew, settings = "members" in memory, config.collection
    members = memory["members"] if is_crew else [memory]
    are_counts = not is_crew or len(members) == len(memory["ended"]) == len(memory["shares"])
    if not are_counts or not all(member is None or _is_whole(member) for member in members):
        raise DamageError(f"the last save in {folder} is damaged: its running episodes have another form")
    sizes = {len(member["episodes"]) for member in members if member is not None}
    is_same_kind = is_crew == (settings.overlap and not _is_alone(settings))
    if not is_same_kind or len(members) != settings.workers or not sizes <= {config.env.num_envs}:
        raise UserError(
            f"collection.workers, collection.backend and env.num_envs in {folder / RUN_FILE} no longer fit the running "
            "episodes of the last save: give them the values that they had there, or start a new run"
        )


def end_episodes(memory: dict[str, Any]) -> dict[str, Any]:
    """The state of a collector as `Collected.memory` holds it, without its running episodes."""
    records = [record | {"actions": record["actions"][:0]} for record in memory["episodes"]]
    return memory | {"episodes": records, "has_ended": np.ones_like(memory["has_ended"])}


def _is_whole(memory: dict[str, Any]) -> bool:
    """Whether the state of a collector holds a return and an end for each of its episodes."""
    num, has_ended = len(memory["episodes"]), memory["has_ended"]
    are_actions = all(record["actions"].ndim == 2 for record in memory["episodes"])
    is_right = memory["returns"].shape == has_ended.shape == (num,) and has_ended.dtype in (torch.bool, np.bool_)
    return bool(are_actions and is_right)


def _is_alone(settings: CollectionConfig) -> bool:
    """Whether one process on this machine collects, which needs no crew."""
    return settings.backend == "process" and settings.workers == 1


def _concatenate(parts: Sequence[Rows]) -> Rows:
    if len(parts) == 1:
        return parts[0]
    return Rows(**{each.name: np.concatenate([getattr(part, each.name) for part in parts]) for each in fields(Rows)})
