"""The page of the runs that were killed."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from fmu.tables import markdown_table
from tests.validation.kills import KILLS, OF_THEM_WRITING, PHASES, Row
from tests.validation.kills_run import LOSS_S, LOSS_STEPS, SIZES


def write(rows: Sequence[Row], directory: Path, processor_s: float) -> None:
    """Write ``kills.md`` into the directory."""
    failures = [failure for row in rows for failure in row.failures]
    kills, runs = sum(sum(row.phases.values()) for row in rows), sum(row.runs for row in rows)
    verdict = f"**{kills} kills; all {runs} runs came to what they would have come to, bit for bit.**"
    if failures:
        verdict = "**What is wrong:**\n\n" + "\n".join(f"- {failure}" for failure in failures)
    directory.mkdir(parents=True, exist_ok=True)
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
    head = ["sampler", "steps", "groups", "s", "kills", *PHASES, "again and again", "bitwise equal"]
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
    head = ["sampler", "most steps lost", "allowed", "longest time lost, s", "allowed, s"]
    return markdown_table(
        head,
        [
            [row.name, f"{row.steps}", f"{LOSS_STEPS}", f"{row.lost_s:.2f}", f"{LOSS_S:g} and a step"]
            for row in rows
        ],
    )


PAGE = """# Runs that are killed

Written by `python -m tests.validation.kills results` in {minutes:.0f} minutes of processor time. {verdict}

Every sampler on `cantilever-young` by shape, kept on disk with `Checkpoint(directory, draws={steps},
seconds={seconds:g})`, is killed with SIGKILL and gone on with by the same call. All draws of warm-up and posterior
and all their statistics are compared, every bit of them, with a run in one process that nothing is kept of.

{once} runs of each sampler are killed once: {writing} of them between two of the system calls that a file is
written with (the content to the disk, the new name, the directory), the others at moments drawn uniformly over the
time that a run takes. One more run of each is killed again and again, in a new interpreter every time, until it
comes to its end in spite of that; every fourth time while it starts. The last of the runs is one that nobody
kills. "starting" is before the first step, "writing" a kill between such system calls.

{kills}
What a kill costs: the steps of a group of chains that a line on a pipe had told when the process died, without
those that are in its files; and the time that they had taken. The time allowed is that of the setting and of the
step in which it runs out, and the time on a busy machine includes what other programs took.

{losses}"""
