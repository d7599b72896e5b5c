"""`benchmark.py suite --tasks dmc20 --frames N --seeds 0 1 --out DIR`: many tasks and seeds, beside published returns.

Every run is a `train.py` process; some run side by side. The same command goes on with a sweep that was interrupted.
`DIR/results.csv` holds one row per evaluation of each run, and `--report FILE.md` writes tables and plots of such rows.
`--results FILE` takes the rows of an earlier sweep and runs nothing; `--merge DIR` first adds the rows of a sweep.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from bench.anchors import TASK_GROUPS
from bench.runs import RunsRequest, TrainingRun
from bench.suite_progress import Board
from bench.suite_queue import Queue
from bench.suite_ray import make_start
from bench.suite_rows import Row, merge_rows, present_origin, read_rows, write_rows
from latentplan.config import Config, UserError
from latentplan.config.checks import at_least, output_file
from latentplan.config.estimates import count_cores
from latentplan.config.extras import require_extra
from latentplan.config.files import has_cuda
from latentplan.config.learning import CollectionBackend
from latentplan.config.parsing import option
from latentplan.config.run_folder import lock_folder
from latentplan.config.suites import DEFAULT_SUITE, check_task
from latentplan.training.signals import exit_code

DEFAULT_TASKS, DEFAULT_SEEDS = ("dmc20",), (0, 1)
RESULTS = "results.csv"


@dataclass(frozen=True, kw_only=True)
class Request(RunsRequest):
    """Flags of `benchmark.py suite`.

    Attributes:
        tasks: Tasks, each as domain-task, or dmc20 (the twenty tasks with published returns) or dev (seven of them);
            dmc20 unless given.
        seeds: Seeds of each task; 0 and 1 unless given. The first seed of all tasks comes before the second.
        frames: Simulator frames of each run. The report compares returns at this number of frames.
        jobs: Runs side by side. As many as there are cores get one thread each, and so do runs on a cluster.
        backend: Where the runs are: `process` starts them on this machine, `ray` on those of a Ray cluster, where
            checkout and folder of results have the same paths.
        ray_address: Address of the cluster as HOST:PORT; None starts Ray on this machine.
        report: Markdown file of tables; its plots are written beside it.
        results: File of rows, from which the report is made, and nothing is run.
        merge: Folder of a sweep, whose rows (of the given tasks and seeds) are added to the file of results first.
    """

    tasks: tuple[str, ...] = option((), separator=",", metavar="dmc20|dev|A,B,...")
    seeds: tuple[int, ...] = option((), separator=",")
    frames: int = 100_000
    out: Path = option(Path("runs/suite"), metavar="DIR")
    jobs: int = 1
    backend: CollectionBackend = "process"
    ray_address: str | None = option(None, metavar="HOST:PORT")
    report: Path | None = option(None, metavar="FILE.md", is_output=True)
    results: Path | None = option(None, metavar="FILE")
    merge: Path | None = option(None, metavar="DIR")

    def __post_init__(self) -> None:
        super().__post_init__()
        at_least(self, jobs=1)
        object.__setattr__(self, "tasks", expand_tasks(self.tasks))
        if self.report is not None and self.report.suffix != ".md":
            raise UserError(f"--report {str(self.report)!r} must end with .md")
        if self.ray_address is not None and self.backend != "ray":
            raise UserError("--ray-address has no effect here: give --backend ray too")
        if self.merge is not None and self.results is None:
            raise UserError("--merge needs --results FILE, the file to which the rows are added")
        if self.results is not None and self.merge is None and self.report is None:
            raise UserError("--results needs --report FILE.md, or --merge DIR, or both")
        if self.results is not None:
            self._refuse_flags_of_runs()

    @property
    def runs(self) -> list[TrainingRun]:
        """The runs in the order in which they start: the first seed of every task, then the second."""
        extra = self.forwarded
        if (self.jobs >= count_cores() or self.backend == "ray") and "threads" not in self.settings.get("run", {}):
            extra = (*extra, "--run.threads", "1")
        return [
            TrainingRun(task, seed, self.out / f"{task}-seed{seed}", self.budget, extra)
            for seed in self.seeds or DEFAULT_SEEDS
            for task in self.tasks or expand_tasks(DEFAULT_TASKS)
        ]

    def _refuse_flags_of_runs(self) -> None:
        defaults = {"minutes": None, "preset": None, "device": None, "config": None, "jobs": 1, "backend": "process"}
        given = [name for name, default in defaults.items() if getattr(self, name) != default]
        given += [f"{section}.{name}" for section, fields in self.settings.items() for name in fields]
        if given:
            raise UserError(f"--{given[0]} has no effect with --results, which runs nothing: leave it out")


def run(request: Request) -> int:
    """Works off the runs that are not finished, or takes rows of earlier ones; then writes the report.

    Returns:
        0; 1 if a run failed; 128 and the number of a signal that interrupted the sweep.
    """
    if request.report is not None:
        require_extra("--report", "rliable")
    has_failures = False
    if request.results is not None:
        rows = _take_rows(request, request.results)
    else:
        board, number = _sweep(request)
        if number:
            print("stopped; the same command goes on with the sweep")
            return exit_code(number)
        wanted = {(each.task, each.seed) for each in request.runs}
        rows = [row for row in board.rows if (row.task, row.seed) in wanted]
        has_failures = bool(board.failures)
        if has_failures:
            print(f"runs that failed: {len(board.failures)}; the same command tries them again")
    if request.report is not None:
        from bench.suite_report import write_report

        try:
            write_report(rows, request.frames, request.report)
            print(f"the report is {request.report}, with its plots beside it")
        except UserError as error:
            if not has_failures:
                raise
            print(f"no report: {error}")
    return int(has_failures)


def expand_tasks(names: tuple[str, ...]) -> tuple[str, ...]:
    """The tasks that names stand for, each once, as domain-task.

    Args:
        names: Tasks, groups of tasks, or domains, which stand for their usual task.

    Raises:
        UserError: There is no such task.
    """
    tasks: list[str] = []
    for name in names:
        domain, _, task = name.partition("-")
        if name in TASK_GROUPS:
            tasks += TASK_GROUPS[name]
            continue
        try:
            usual = check_task(DEFAULT_SUITE, domain, task or None)[0]
        except UserError as error:
            raise UserError(f"--tasks {name}: {error} (or one of {', '.join(TASK_GROUPS)})") from None
        tasks.append(f"{domain}-{task or usual}")
    return tuple(dict.fromkeys(tasks))


def _sweep(request: Request) -> tuple[Board, int]:
    """Runs the sweep; returns its board, and the number of the signal that interrupted it or 0."""
    runs = request.runs
    if request.backend == "ray":
        require_extra("--backend ray", "ray")
    configs = [each.check() for each in runs]  # refuses a mistake in any run before the first run begins
    with lock_folder(request.out, "another sweep runs"):
        is_here = request.backend == "process"
        origin = present_origin(request.jobs, any(map(_learns_on_gpu, configs))) if is_here else None
        start = None if is_here else make_start(request.ray_address, request.jobs)
        board = Board(runs, request.jobs, request.out / RESULTS, origin)
        print(board.status(), flush=True)
        number = Queue(runs, request.jobs, board, start).work_off()
    print(f"{request.out / RESULTS} holds {len(board.rows)} rows")
    return board, number


def _take_rows(request: Request, results: Path) -> list[Row]:
    """The rows of a file of results, with those of a sweep added to it, of the tasks and seeds that were asked for."""
    rows = read_rows(results)
    if request.merge is not None:
        sweep = read_rows(request.merge / RESULTS)
        if not sweep:
            raise UserError(f"{request.merge / RESULTS} holds no rows; give the folder of a sweep to --merge")
        new = _select(request, sweep)
        if not new:
            raise UserError(f"{request.merge / RESULTS} holds no rows of these --tasks and --seeds")
        rows = merge_rows(rows, new)
        write_rows(output_file(results, "--results"), rows)
        print(f"{results} holds {len(rows)} rows, {len(new)} of them from {request.merge}")
    if not rows:
        raise UserError(f"{results} holds no rows; --merge DIR adds the rows of a sweep")
    return _select(request, rows)


def _select(request: Request, rows: Sequence[Row]) -> list[Row]:
    """The rows of the tasks and seeds that were asked for, or all."""
    return [
        row for row in rows if row.task in (request.tasks or (row.task,)) and row.seed in (request.seeds or (row.seed,))
    ]


def _learns_on_gpu(config: Config) -> bool:
    return config.run.device != "cpu" and has_cuda()
