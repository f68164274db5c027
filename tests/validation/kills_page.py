"""The page of the study of killed and resumed runs."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from fmu.tables import markdown_table
from tests.validation.kills import DRAWS, KILLS, OF_THEM_WRITING, PHASES, STARTING, WARMUP, WRITING, Row
from tests.validation.kills_run import LOSS_S, LOSS_STEPS, SIZES

_PHASE_LABELS = {STARTING: "at the start", WARMUP: "in warm-up", DRAWS: "in draws", WRITING: "in writing"}


def write(rows: Sequence[Row], directory: Path, processor_s: float) -> None:
    """Write ``kills.md`` into the directory."""
    failures = [failure for row in rows for failure in row.failures]
    kills, runs = sum(sum(row.phases.values()) for row in rows), sum(row.runs for row in rows)
    verdict = f"**{kills} kills; all {runs} runs came out identical to an uninterrupted run, bit for bit.**"
    if failures:
        verdict = f"**{kills} kills; failures:**\n\n" + "\n".join(f"- {failure}" for failure in failures)
    page = PAGE.format(
        verdict=verdict,
        minutes=processor_s / 60.0,
        once=KILLS,
        writing=OF_THEM_WRITING,
        steps=LOSS_STEPS,
        seconds=LOSS_S,
        kills=_kills(rows),
        losses=_losses(rows),
    )
    (directory / "kills.md").write_text(page)


def _kills(rows: Sequence[Row]) -> str:
    head = [
        "sampler", "warm-up + draws", "groups", "duration, s", "kills", *map(_PHASE_LABELS.get, PHASES),
        "repeated kills", "identical runs",
    ]  # fmt: skip
    cells = []
    for row in rows:
        size = SIZES[row.name]
        phases = [f"{row.phases[phase]}" for phase in PHASES]
        cells.append([
            row.name, f"{size.warmup} + {size.draws}", f"{size.groups}", f"{row.seconds:.1f}",
            f"{sum(row.phases.values())}", *phases, f"{row.again}", f"{row.equal} of {row.runs}",
        ])  # fmt: skip
    return markdown_table(head, cells)


def _losses(rows: Sequence[Row]) -> str:
    head = ["sampler", "most steps lost", "allowed", "most time lost, s", "allowed, s"]
    return markdown_table(
        head,
        [
            [row.name, f"{row.steps}", f"{LOSS_STEPS}", f"{row.lost_s:.2f}", f"{LOSS_S:g} + 2 steps"]
            for row in rows
        ],
    )


PAGE = """# Runs that are killed and resumed

Does a run that is killed and resumed give the same draws as an uninterrupted run?

{verdict}

Each sampler runs on the paper's beam (`cantilever-young`, modes paired by shape) with
`Checkpoint(directory, draws={steps}, seconds={seconds:g})`. The process is killed with SIGKILL, and the same call
resumes the run. All draws of warm-up and posterior and all sampler statistics are compared bit for bit with a run
in one process without checkpoints. The study took {minutes:.0f} minutes of processor time.

For each sampler, {once} runs are killed once. Of these kills, {writing} fall between two of the system calls that
write a checkpoint file (flush the content, rename, flush the directory). The others come at times drawn uniformly
over the duration of a run. One further run is killed repeatedly, in a new interpreter each time, until it
finishes; every fourth kill comes within a second of the interpreter's start. One more run with checkpoints is not
killed. In the table, "at the start" means before the first step, and "in writing" between two such system calls.

{kills}
A kill loses the steps that a group of chains had reported before the process died, but had not yet saved. At most
{steps} steps may be lost, and at most {seconds:g} s plus twice the longest time between two steps. Times include
time that other programs took on a busy machine.

{losses}"""
