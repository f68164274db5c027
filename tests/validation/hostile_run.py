"""What ``fmu check`` says of a hostile file, how long that takes and how much memory; in a process that may die.

python -m tests.validation.hostile_run        reads numbers of files, a line each, and answers with lines of JSON
"""

from __future__ import annotations

import gc
import json
import os
import re
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
import traceback
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

SOON_S, MOST_S, PATIENCE_S = 5.0, 60.0, 900.0
"""Seconds of processor that a refusal may take, after which a check is ended, and by the clock, when it waits."""
MOST_MIB, MOST_OF_ALL_MIB = 1024.0, 6144.0
LONGEST_MESSAGE = 20_000
BAD_INPUT = 2
MACHINE_WORDS = re.compile(
    r"Traceback|<class|object at 0x|NoneType|subscriptable|has no attribute|unexpected keyword|numpy\.|np\.|ufunc|unpack|"
    r"site-packages|pydantic|\[type=|concatenation axis|broadcast|fmu/\S+\.py:\d+: \w+Warning|Exception ignored|datetime\.|match pattern"
)
"""What a message in plain words does not have."""


@dataclass(frozen=True)
class Verdict:
    """What came of a file.

    Attributes
    ----------
    name : str
        Of what kind it is.
    code : int or None
        Exit code of ``fmu check``; None if it did not end by itself.
    fault : str
        What is wrong with what it did; empty if nothing is.
    processor_s, peak_mib : float
    message : str
        The end of what was printed.
    """

    name: str
    code: int | None
    fault: str
    processor_s: float
    peak_mib: float
    message: str


def checked(name: str, path: Path, most_mib: float = MOST_MIB) -> Verdict:
    """Check a file in this process, as the command line does."""
    from click.testing import CliRunner

    from fmu import cli

    _forget_peak()
    began = time.process_time()
    code, crash = None, ""
    try:
        arguments = ["check", str(path), "--draws", "2", "--out", str(path.parent / "page")]
        result = CliRunner().invoke(cli.main, arguments, prog_name="fmu")
        code, text = result.exit_code, result.output
        if result.exception is not None and not isinstance(result.exception, SystemExit):
            crash = "".join(traceback.format_exception(result.exception))
    except BaseException as error:  # of a user's function; only another signal to stop is not its own
        text, crash = "", "".join(traceback.format_exception(error))
    taken_s, peak = time.process_time() - began, _peak_mib()
    fault = f"traceback: {crash.strip().splitlines()[-1][:200]}" if crash else ""
    fault = fault or wrong(code, text, taken_s, peak, most_mib) or (_start(path) if code == 0 else "")
    return Verdict(name, code, fault, taken_s, peak, text[-600:] if not crash else crash[-1500:])


def checked_alone(name: str, path: Path) -> Verdict:
    """Check a file by a process of its own."""
    arguments = ["check", str(path), "--draws", "2", "--out", str(path.parent / "page")]
    out = path.parent / "said"
    with out.open("wb") as said:
        process = subprocess.Popen(
            [sys.executable, "-m", "fmu", *arguments], stdout=said, stderr=said, preexec_fn=limit
        )
        _, status, usage = os.wait4(process.pid, 0)
    taken_s, peak = usage.ru_utime + usage.ru_stime, usage.ru_maxrss / 1024.0
    code = os.waitstatus_to_exitcode(status)
    process.returncode = code
    text = out.read_text(encoding="utf-8", errors="replace")
    return Verdict(name, code, wrong(code, text, taken_s, peak), taken_s, peak, text[-600:])


def wrong(code: int | None, text: str, taken_s: float, peak_mib: float, most_mib: float = MOST_MIB) -> str:
    """Say what is wrong with how a check ended, if anything is."""
    if code == -signal.SIGXCPU:
        return f"late: no end within {MOST_S:g} s"
    if code is not None and code < 0:
        return f"died of signal {-code}"
    if "Traceback (most recent call last)" in text:
        return f"traceback: {text.strip().splitlines()[-1][:200]}"
    if code not in (0, BAD_INPUT):
        return f"exit code {code}"
    if peak_mib > most_mib:
        return f"memory: {peak_mib:.0f} MiB"
    if code == BAD_INPUT:
        if taken_s > SOON_S:
            return f"late: {taken_s:.1f} s"
        return unclear(text)
    found = re.search(r"[^\n]*fmu/\S+\.py:\d+: \w+Warning:[^\n]*", text)
    return f"message: {found.group()[:200]}" if found else ""


def unclear(text: str) -> str:
    """Say why a refusal is not in plain words, if it is not."""
    if "Error: " not in text or not text.partition("Error: ")[2].strip():
        return "message: there is none"
    if len(text) > LONGEST_MESSAGE:
        return f"message: {len(text)} characters"
    found = MACHINE_WORDS.search(text)
    if found:
        at = max(text.rfind("\n", 0, found.start()), 0)
        return f"message: {text[at : at + 250].strip()}"
    strange = next((c for c in text if not c.isprintable() and c != "\n"), "")
    return f"message: has the character {strange!r}" if strange else ""


def _start(path: Path) -> str:
    """Say what is wrong with a problem at its start, if anything is."""
    import numpy as np

    import fmu

    problem = fmu.load(path)
    value = problem.log_prob(problem.start)
    return "" if np.isfinite(value) else f"start: the log-probability is {value}"


def limit_memory() -> None:
    """Keep this process from taking the machine's memory."""
    most = int(MOST_OF_ALL_MIB * 2**20)
    resource.setrlimit(resource.RLIMIT_AS, (most, most))


def limit() -> None:
    """Keep this process from taking the machine's memory, or its time."""
    limit_memory()
    resource.setrlimit(resource.RLIMIT_CPU, (int(MOST_S), int(MOST_S)))


def _forget_peak() -> None:
    gc.collect()
    with suppress(OSError):  # not Linux: the peak is that of the process so far
        Path("/proc/self/clear_refs").write_text("5")


def _peak_mib() -> float:
    try:
        status = Path("/proc/self/status").read_text()
        return float(re.search(r"VmHWM:\s+(\d+) kB", status).group(1)) / 1024.0  # type: ignore[union-attr]
    except (OSError, AttributeError):
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0


class Worker:
    """A process that checks files, one after the other; another takes its place when it dies."""

    def __init__(self, seed: int) -> None:
        self.seed = seed
        self.process: Any = None

    def check(self, which: str) -> Verdict:
        """Check one file."""
        if self.process is None:
            self.process = subprocess.Popen(
                [sys.executable, "-m", "tests.validation.hostile_run", str(self.seed)],
                stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True,
            )  # fmt: skip
        process = self.process
        killer = threading.Timer(PATIENCE_S, process.kill)
        killer.start()
        name = which
        try:
            process.stdin.write(f"{which}\n")
            process.stdin.flush()
            while line := process.stdout.readline():
                if line.startswith("{"):
                    return Verdict(**json.loads(line))
                name = line.partition("name: ")[2].strip() or name
        except BrokenPipeError:
            pass
        finally:
            killer.cancel()
        how = -process.wait()
        self.process = None
        ends = {signal.SIGPROF: f"late: no end within {MOST_S:g} s", signal.SIGKILL: "late: it waits without end"}
        return Verdict(name, None, ends.get(how, f"died of signal {how}"), 0.0, 0.0, "")  # type: ignore[call-overload]

    def stop(self) -> None:
        """End the process."""
        if self.process is not None:
            self.process.stdin.close()
            self.process.wait()


def verdicts(which: Sequence[str], seed: int, workers: int) -> Iterator[Verdict]:
    """Check files, named as ``problem 17`` or ``beside 3``, in some processes; verdicts come in their order."""
    idle = [Worker(seed) for _ in range(workers)]
    all_of_them = tuple(idle)

    def check(one: str) -> Verdict:
        worker = idle.pop()
        try:
            return worker.check(one)
        finally:
            idle.append(worker)

    try:
        with ThreadPoolExecutor(workers) as threads:
            yield from threads.map(check, which)
    finally:
        for worker in all_of_them:
            worker.stop()


def checked_in(which: str, made: Path, seed: int) -> Verdict:
    """Write a file into a folder of its own, check it, and take it away."""
    from tests.validation.hostile_bases import PROBLEM
    from tests.validation.hostile_beside import beside_file
    from tests.validation.hostile_files import problem_file

    kind, number = which.split()
    hostile = (problem_file if kind == "problem" else beside_file)(int(number), made, seed)
    print(f"name: {hostile.name}", flush=True)
    folder = Path(tempfile.mkdtemp(prefix="hostile-"))
    try:
        hostile.write(folder)
        if hostile.name.startswith("huge"):
            return checked_alone(hostile.name, folder / PROBLEM)
        signal.setitimer(signal.ITIMER_PROF, MOST_S)  # whose signal ends the process
        return checked(hostile.name, folder / PROBLEM)
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        shutil.rmtree(folder, ignore_errors=True)


def _import_everything(made: Path) -> None:
    """Check a right file, so that no other one is blamed for imports."""
    from tests.validation.hostile_bases import bases, put

    base = bases(made)["frame"]
    (made / "right").mkdir()
    checked("frame", put(made / "right", base, base.text.encode()))
    gc.collect()
    gc.freeze()


def main(seed: int) -> None:
    """Answer each line with a verdict."""
    limit_memory()
    with tempfile.TemporaryDirectory() as made:
        os.environ["FMU_CACHE_DIR"] = made
        out = sys.stdout
        _import_everything(Path(made))
        for line in sys.stdin:
            verdict = checked_in(line.strip(), Path(made), seed)
            print(json.dumps(asdict(verdict)), file=out, flush=True)


if __name__ == "__main__":
    main(int(sys.argv[1]))
