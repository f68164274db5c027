"""Kill runs of every sampler without warning and resume them.

    python -m tests.validation.kills OUT [--kept DIRECTORY] [--minutes M]

The exit code is 1 if a resumed run differs in any bit from the uninterrupted run, or if a kill loses more work
than is allowed.
"""

from __future__ import annotations

import fcntl
import itertools
import os
import signal
import subprocess
import sys
import time
import traceback
import warnings
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from fmu.runs.content import numbered_files, read_state
from tests.validation.kept import Units, each, fields_of, study_parser
from tests.validation.kills_run import LOSS_S, LOSS_STEPS, SIZES, drawn, load, same, teller

KILLS, OF_THEM_WRITING, SEED = 20, 6, 1
STARTING, WARMUP, DRAWS, WRITING = "starting", "warmup", "draws", "writing"
PHASES = (STARTING, WARMUP, DRAWS, WRITING)
_PIPE = 1 << 20  # bytes: enough for all progress lines of a run
_MOST_DEATHS = 60  # of the run that is killed repeatedly
_MOST_TRIES = 30  # attempts to kill a run before it finishes
_CALLS = ("fsync", "replace")  # functions of `os` that write a file durably


class Step(NamedTuple):
    """A step, as reported by a progress line."""

    group: int
    phase: str
    number: int
    time: float


@dataclass
class Row:
    """Results of the kills of one sampler.

    Attributes
    ----------
    name : str
        The sampler.
    seconds : float
        Duration of the uninterrupted run.
    phases : dict of str to int
        Number of kills in each phase.
    runs, equal : int
        Number of runs that were compared, and how many of them equal the uninterrupted run bit for bit.
    steps, lost_s : int, float
        The most steps, and the most time, that a kill cost a group of chains.
    longest_s : float
        The longest time between two steps, including the writing of files.
    again : int
        Number of kills of the run that is killed repeatedly.
    alarms : int
        Number of resumed runs that warned of different floating-point arithmetic, on the same machine.
    """

    name: str
    seconds: float
    phases: dict[str, int] = field(default_factory=lambda: dict.fromkeys(PHASES, 0))
    runs: int = 0
    equal: int = 0
    steps: int = 0
    lost_s: float = 0.0
    longest_s: float = 0.0
    again: int = 0
    alarms: int = 0

    @property
    def failures(self) -> Iterator[str]:
        """Failures, one sentence each."""
        if self.equal < self.runs:
            yield f"{self.name}: {self.runs - self.equal} of {self.runs} runs differ from the uninterrupted run"
        if self.steps > LOSS_STEPS:
            yield f"{self.name}: a kill lost {self.steps} steps; {LOSS_STEPS} are allowed"
        if self.lost_s > LOSS_S + 2.0 * self.longest_s:
            allowed = f"{LOSS_S:g} s and twice the longest step of {self.longest_s:.2f} s are allowed"
            yield f"{self.name}: a kill lost {self.lost_s:.2f} s; {allowed}"
        if self.alarms:
            yield f"{self.name}: {self.alarms} resumed runs warned of different arithmetic on the same machine"

    def kill(self, directory: Path, told: list[Step], phase: str | None = None) -> None:
        """Record the phase of a kill and the steps and time that it lost."""
        self.phases[phase or (told[-1].phase if told else STARTING)] += 1
        times = [step.time for step in told]
        took = [later - earlier for earlier, later in zip(times[:1] + times, times, strict=False)]
        self.longest_s = max(self.longest_s, *took) if told else self.longest_s
        for group in {step.group for step in told}:
            done = kept_steps(directory / f"group-{group}")
            lost = [
                s
                for step, s in zip(told, took, strict=True)
                if step.group == group and step.number > done[step.phase]
            ]
            self.steps, self.lost_s = max(self.steps, len(lost)), max(self.lost_s, sum(lost))

    def went_on(self, found: Mapping[str, NDArray[Any]], reference: Mapping[str, NDArray[Any]]) -> None:
        """Compare a finished run with the reference and record the result."""
        self.runs += 1
        self.equal += same(found, reference)


def kept_steps(directory: Path) -> Mapping[str, int]:
    """Return how many steps of each phase are saved for a group of chains."""
    states = numbered_files(directory, "state")
    return read_state(states[-1][1]).group_state.done if states else {WARMUP: 0, DRAWS: 0}


def forked(work: Callable[[int], object]) -> tuple[int, int]:
    """Run ``work(pipe)`` in a forked process; return its process number and the pipe's reading end."""
    reading, writing = os.pipe()
    fcntl.fcntl(writing, fcntl.F_SETPIPE_SZ, _PIPE)
    number = os.fork()
    if number:
        os.close(writing)
        return number, reading
    try:
        os.close(reading)
        work(writing)
        os._exit(0)
    except BaseException:
        traceback.print_exc()
    os._exit(1)


def steps_told(reading: int) -> list[Step]:
    """Return the steps of all complete lines in a pipe whose writing end is closed."""
    with os.fdopen(reading, "rb") as pipe:
        return [parsed(line) for line in pipe.read().split(b"\n")[:-1]]


def parsed(line: bytes) -> Step:
    """Return the step reported by a progress line."""
    group, phase, number, now = line.decode().split()
    return Step(int(group), phase, int(number), float(now))


def die_at(call: int) -> None:
    """Make this process kill itself before system call number `call` among the calls that write files."""
    count = itertools.count()

    def deadly(true: Callable[..., Any]) -> Callable[..., Any]:
        def instead(*arguments: Any) -> Any:
            if next(count) == call:
                os.kill(os.getpid(), signal.SIGKILL)
            return true(*arguments)

        return instead

    for name in _CALLS:
        setattr(os, name, deadly(getattr(os, name)))


def killed_once(
    problem: Any, row: Row, reference: Mapping[str, Any], rng: np.random.Generator, n_calls: int
) -> None:
    """Kill `KILLS` runs once each, and resume each of them."""
    for k in range(KILLS):
        writing = k < OF_THEM_WRITING
        status = 0
        for _ in range(_MOST_TRIES):
            if os.WIFSIGNALED(status):  # otherwise the run finished before the kill: try again
                break
            with TemporaryDirectory() as folder:
                directory = Path(folder)
                call = int(rng.integers(n_calls)) if writing else -1

                def work(pipe: int, directory: Path = directory, call: int = call) -> None:
                    die_at(call)
                    drawn(problem, row.name, directory, teller(pipe))

                number, reading = forked(work)
                if not writing:
                    time.sleep(rng.uniform(0.0, row.seconds))
                    os.kill(number, signal.SIGKILL)
                _, status = os.waitpid(number, 0)
                told = steps_told(reading)
                if os.WIFSIGNALED(status):
                    row.kill(directory, told, WRITING if writing else None)
                    with warnings.catch_warnings(record=True) as seen:
                        warnings.simplefilter("always")
                        row.went_on(drawn(problem, row.name, directory), reference)
                    row.alarms += bool(seen)
        if not os.WIFSIGNALED(status):
            raise RuntimeError(f"{row.name}: the run finished before the kill in all {_MOST_TRIES} attempts")


def killed_again_and_again(row: Row, reference: Mapping[str, Any], rng: np.random.Generator) -> None:
    """Kill and resume one run repeatedly, in a new interpreter each time, until it finishes."""
    with TemporaryDirectory() as folder:
        directory, result = Path(folder) / "run", Path(folder) / "result.npz"
        command = [
            sys.executable,
            "-m",
            "tests.validation.kills_run",
            row.name,
            os.fspath(directory),
            os.fspath(result),
        ]
        for attempt in range(_MOST_DEATHS):
            with subprocess.Popen(command, stdout=subprocess.PIPE, bufsize=0, pipesize=_PIPE) as process:
                if attempt % 4 == 1:
                    time.sleep(rng.uniform(0.0, 1.0))
                    told = []
                else:
                    first = process.stdout.readline()  # type: ignore[union-attr]
                    told = [parsed(first)] if first else []
                    time.sleep(rng.uniform(0.0, 0.7 * row.seconds) if first else 0.0)
                    if not first:
                        process.wait()
                process.kill()
                rest = process.stdout.read().split(b"\n")[:-1]  # type: ignore[union-attr]
                if process.wait() == 0:
                    with np.load(result) as file:
                        row.went_on(dict(file), reference)
                    return
            row.again += 1
            row.kill(directory, [*told, *map(parsed, rest)])
    row.runs += 1  # it never finished: counted as a run that differs


def killed(problem: Any, name: str) -> Row:
    """Kill and resume the runs of a sampler; return the results."""
    rng = np.random.default_rng([SEED, list(SIZES).index(name)])
    reference = drawn(problem, name)
    with TemporaryDirectory() as folder:
        directory = Path(folder)
        began = time.monotonic()
        number, reading = forked(lambda pipe: drawn(problem, name, directory, teller(pipe)))
        _, status = os.waitpid(number, 0)
        row = Row(name, time.monotonic() - began)
        if status or len(steps_told(reading)) == 0:
            raise RuntimeError(f"{name}: the uninterrupted run did not finish")
        row.went_on(drawn(problem, name, directory), reference)
        writes = sum(2 * numbered_files(group, "state")[-1][0] for group in directory.glob("group-*"))
    killed_once(problem, row, reference, rng, n_calls=3 * writes)
    killed_again_and_again(row, reference, rng)
    return row


def main() -> int:
    """Run the study, write ``kills.md``, and return the exit code."""
    from tests.validation.kills_page import write

    asked = study_parser(__doc__).parse_args()
    units = Units(asked.kept, asked.minutes)
    with threadpool_limits(1):
        problem = load()
        rows = units.completed("samplers", each(SIZES), lambda name: killed(problem, name), fields_of(Row))
    write(rows, asked.out, units.processor_s)
    failures = [failure for row in rows for failure in row.failures]
    for failure in failures:
        print(failure)
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(main())
