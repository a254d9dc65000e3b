"""Make the runs of a manifest, as many at a time as there are cores.

``python run.py --only figure1 --tasks copy,reverse --seeds 1-3``. What is done is skipped. Ctrl-C
or SIGTERM lets each run write a checkpoint; the same command goes on from there, also after a kill.
``--stack 5`` makes up to five runs of a cell in one process, where the script can. Runs that have
begun go on as they were begun. ``--missing`` makes none whose results are committed.
"""

from __future__ import annotations

import dataclasses
import fcntl
import os
import re
import shlex
import signal
import subprocess
import sys
import time
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from types import FrameType

from manifest import (
    Cell,
    add_ignored,
    add_selection,
    argument_parser,
    read_manifests,
)
from omegaconf import DictConfig, OmegaConf
from records import Record, find_record
from results import RESULTS, Results

POLL = 0.2  # seconds
LOG_LINES = 12
STACKED_KINDS = ("algorithmic", "bandit")  # of tasks, as ecpo/stacked/options.py has it
# One thread a run: fastest at these sizes, and as many runs as cores.
ENVIRONMENT = {"OMP_NUM_THREADS": "1", "MUJOCO_GL": "disabled"}


@dataclass(frozen=True)
class Run:
    """A run that the manifest asks for, or stacked ones, which a process makes together."""

    cell: Cell
    seeds: tuple[int, ...]
    directory: Path
    ignored: Sequence[str] = ()

    def __str__(self) -> str:
        """For messages."""
        return f"{self.cell.name}/seed {', '.join(map(str, self.seeds))}"

    @property
    def records(self) -> dict[int, Record]:
        """What is there of each seed."""
        places = {self.seeds[0]: self.directory}
        if len(self.seeds) > 1:
            places = {seed: self.directory / f"seed_{seed}" for seed in self.seeds}
        found = {seed: find_record(place) for seed, place in places.items()}
        return {seed: record for seed, record in found.items() if record is not None}

    @property
    def is_done(self) -> bool:
        """Whether all steps are there; of a longer run, as many as were asked for.

        Raises:
            ValueError: if the directory holds a run of another configuration.
        """
        records = self.records
        for seed, record in records.items():
            changes = record.changes(self.cell, seed, self.ignored)
            if changes:
                raise ValueError(
                    f"{self.directory} holds a run of another configuration: {'; '.join(changes)}. "
                    "Remove it, give another directory with --runs, or, if that makes no "
                    "difference, --ignore these entries."
                )
        return len(records) == len(self.seeds) and all(
            (record.finished or record.total > self.cell.steps)
            and record.reached >= self.cell.steps
            for record in records.values()
        )

    @property
    def command(self) -> list[str]:
        """What makes the run, or goes on with it.

        When a run finished it left out its replay buffer; with one, a longer run begins anew.
        """
        records = self.records.values()
        is_over = any(
            record.finished and record.total < self.cell.steps and "replay_buffer" in record.config
            for record in records
        )
        steps = max([self.cell.steps, *(record.total for record in records)])
        seeds = f"seed={self.seeds[0]}"
        if len(self.seeds) > 1:
            seeds = f"seeds={list(self.seeds)}".replace(" ", "")
        return [
            *(sys.executable, str(self.cell.script), *self.cell.options, seeds),
            f"{self.cell.total_option}={steps}",
            f"hydra.run.dir='{self.directory}'",
            f"resume={'null' if is_over else 'auto'}",
        ]


def planned_runs(
    cells: Sequence[Cell], directory: Path, ignored: Sequence[str] = (), stack: int = 1
) -> list[Run]:
    """Every run once, by seed first: a study that is stopped early has something of each cell."""
    wanted: dict[Path, dict[int, Cell]] = {}
    for cell in cells:
        by_seed = wanted.setdefault(cell.directory(directory), {})
        for seed in cell.seeds:
            if seed not in by_seed or by_seed[seed].steps < cell.steps:
                by_seed[seed] = cell
    runs = []
    for base, by_seed in wanted.items():
        size = stack if can_be_stacked(next(iter(by_seed.values())).config) else 1
        for seeds in partition(list(by_seed), begun(base), size):
            longest = max((by_seed[s] for s in seeds if s in by_seed), key=lambda cell: cell.steps)
            name = "seed" if len(seeds) == 1 else "seeds"
            run = Run(longest, seeds, base / "_".join([name, *map(str, seeds)]), ignored)
            runs.append((min(list(by_seed).index(s) for s in seeds if s in by_seed), run))
    return [run for _, run in sorted(runs, key=lambda pair: pair[0])]


def can_be_stacked(config: DictConfig) -> bool:
    """Whether the script takes several runs that differ in the seed, as ecpo/stacked/ has it."""
    return (
        "seeds" in config
        and OmegaConf.select(config, "env.kind") in STACKED_KINDS
        and OmegaConf.select(config, "loss.class") != "TrustPCLLoss"  # which has a value network
        and OmegaConf.select(config, "collector.backend", default="direct") == "direct"
        and not config.get("compile")
    )


def without_results(
    cells: Sequence[Cell], results: Path, ignored: Sequence[str] = ()
) -> list[Cell]:
    """The cells with those seeds whose results are not committed."""
    committed = {
        study: Results.read(results / "study" / study)
        for study in dict.fromkeys(cell.study for cell in cells)
    }
    left = []
    for cell in cells:
        has = committed[cell.study].has
        seeds = tuple(seed for seed in cell.seeds if not has(cell, seed, ignored))
        left += [dataclasses.replace(cell, seeds=seeds)] if seeds else []
    return left


def begun(base: Path) -> list[tuple[int, ...]]:
    """The seeds of each process that has a directory: ``seed_1``, or ``seeds_1_2`` for a stack."""
    if not base.is_dir():
        return []
    names = (re.fullmatch(r"seeds?_(\d+(?:_\d+)*)", path.name) for path in sorted(base.iterdir()))
    return [tuple(map(int, name[1].split("_"))) for name in names if name]


def partition(
    seeds: Sequence[int], begun: Sequence[tuple[int, ...]], size: int
) -> list[tuple[int, ...]]:
    """The seeds of each process: of those that have begun the same, of others `size`.

    Examples:
        >>> partition([1, 2, 3, 4, 5, 6], begun=[(2,), (4, 5)], size=2)
        [(2,), (4, 5), (1, 3), (6,)]
    """
    parts, left = [], list(seeds)
    for own in begun:
        if set(own) & set(left):
            parts.append(own)
            left = [seed for seed in left if seed not in own]
    return parts + [tuple(left[i : i + size]) for i in range(0, len(left), size)]


@dataclass
class Job:
    """A run in progress, in a process of ours or, with none, of somebody else's."""

    run: Run
    process: subprocess.Popen[bytes] | None
    started: float = dataclasses.field(default_factory=time.monotonic)
    signals: int = 0


class Queue:
    """Runs that wait, and those in progress.

    A run holds a lock on a file in its directory for as long as its process lives, whatever
    becomes of the queue. So a queue that is started again after a kill waits for the runs that
    went on without it.
    """

    def __init__(self, runs: Sequence[Run], workers: int) -> None:
        self.waiting, self.jobs = deque(runs), list[Job]()
        self.total, self.workers = sum(len(run.seeds) for run in runs), workers
        self.done = 0
        self.failures: list[tuple[Run, str]] = []
        self.stopped_by: signal.Signals | None = None
        self._signals = 0

    def work(self) -> None:
        """Until all is done, or a signal has come and all runs of ours have ended."""
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, self._stop)
        while self.waiting or self.jobs:
            while self.waiting and len(self.jobs) < self.workers and self.stopped_by is None:
                self._begin(self.waiting.popleft())
            if self.stopped_by is not None and not any(job.process for job in self.jobs):
                break
            time.sleep(POLL)
            for job in list(self.jobs):
                self._follow(job)

    def _stop(self, number: int, frame: FrameType | None) -> None:
        self.stopped_by = signal.Signals(number)
        self._signals += 1

    def _begin(self, run: Run) -> None:
        run.directory.mkdir(parents=True, exist_ok=True)
        with (run.directory / "lock").open("a") as lock:
            if not _locked(lock.fileno()):
                print(f"waits     {run}: another process runs it", flush=True)
                self.jobs.append(Job(run, process=None))
                return
            try:
                if run.is_done:
                    self._report("is done", run)
                    return
                command = run.command
            except Exception as error:  # whatever a torn file raises: the other runs go on
                self._fail(run, f"{type(error).__name__}: {error}")
                return
            with (run.directory / "log.txt").open("ab") as log:
                process = subprocess.Popen(
                    command,
                    cwd=run.directory,
                    env={**os.environ, **ENVIRONMENT},
                    stdin=subprocess.DEVNULL,
                    stdout=log,
                    stderr=subprocess.STDOUT,
                    # Its copy of the file keeps the lock.
                    pass_fds=[lock.fileno()],
                    # Ctrl-C reaches the queue alone, which passes it on once.
                    start_new_session=True,
                )
        print(f"begins    {run}: {shlex.join(command[1:])}", flush=True)
        self.jobs.append(Job(run, process))

    def _follow(self, job: Job) -> None:
        if job.process is None:
            with (job.run.directory / "lock").open("a") as lock:
                if _locked(lock.fileno()):
                    self.jobs.remove(job)
                    self.waiting.appendleft(job.run)
            return
        if job.signals < self._signals:
            job.process.terminate()
            job.signals = self._signals
        status = job.process.poll()
        if status is None:
            return
        self.jobs.remove(job)
        if status == 0:
            self._report("finished", job.run, f" in {time.monotonic() - job.started:.0f} s")
        elif self.stopped_by is not None:
            print(f"stopped   {job.run}", flush=True)
        else:
            log = (job.run.directory / "log.txt").read_text(errors="replace")
            last = "\n".join(f"    {line}" for line in log.splitlines()[-LOG_LINES:])
            self._fail(job.run, f"status {status}, {job.run.directory}/log.txt ends:\n{last}")

    def _report(self, what: str, run: Run, more: str = "") -> None:
        self.done += len(run.seeds)
        print(f"{what:9} {run}{more} ({self.done} of {self.total})", flush=True)

    def _fail(self, run: Run, why: str) -> None:
        self.failures.append((run, why))
        print(f"failed    {run}", flush=True)


def _locked(file: int) -> bool:
    """Take the lock, unless a process has it."""
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True


def main(arguments: Sequence[str] | None = None) -> int:
    """Make the runs; return the exit status."""
    parser = argument_parser(__doc__)
    add_selection(parser)
    add_ignored(parser)
    parser.add_argument("--runs", type=Path, default=Path("runs/study"), help="directory of runs")
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    parser.add_argument("--workers", type=int, default=cores, help="runs at a time")
    parser.add_argument("--stack", type=int, default=1, help="runs of a cell in one process")
    parser.add_argument("--missing", action="store_true", help="only runs without results yet")
    parser.add_argument("--results", type=Path, default=RESULTS, help="what is committed")
    parser.add_argument("--dry-run", action="store_true", help="list the runs")
    options = parser.parse_args(arguments)
    for name in ("workers", "stack"):
        if getattr(options, name) < 1:
            parser.error(f"--{name} must be at least 1, got {getattr(options, name)}")
    try:
        manifest = read_manifests(options.manifest)
        cells = manifest.select(options.only, options.tasks, options.methods, options.seeds)
        if options.missing:
            cells = without_results(cells, options.results, options.ignore)
        runs = planned_runs(cells, options.runs.resolve(), options.ignore, options.stack)
        for cell in cells:
            assert cell.config, "composed once before anything is run, so that a mistake shows"
    except (ValueError, OSError) as error:
        parser.error(str(error))
    if options.dry_run:
        status = 0
        for run in runs:
            try:
                word = "done" if run.is_done else "to do"
            except Exception as error:  # whatever a torn file raises, as in the queue
                word, status = f"failed ({error})", 1
            print(f"{word}  {run}  {run.directory}")
        return status
    queue = Queue(runs, options.workers)
    processes = f"{queue.total} runs in {len(runs)} processes, {options.workers} at a time"
    print(f"{processes}, in {options.runs.resolve()}", flush=True)
    queue.work()
    for run, why in queue.failures:
        print(f"\n{run}: {why}")
    failed = sum(len(run.seeds) for run, _ in queue.failures)
    print(f"\n{queue.done} of {queue.total} runs are done, {failed} failed.")
    if queue.stopped_by is not None:
        print(f"Stopped by {queue.stopped_by.name}; the same command goes on.")
        return 128 + queue.stopped_by
    return int(bool(queue.failures))


if __name__ == "__main__":
    sys.exit(main())
