"""A study that takes no time, to test how studies are run: it writes how often each of its units was done."""

import os
import sys
from pathlib import Path

from tests.validation.kept import Units, study_parser


def main() -> int:
    """Do the units, and end without a page at the one that the environment names; it is done the next time."""
    asked = study_parser(__doc__).parse_args()
    print(f"budget of {asked.minutes:g} minutes")
    units, log = Units(asked.kept, asked.minutes), Path(os.environ["COUNTED"])

    def count(number: int) -> int:
        with log.open("a") as file:
            file.write(f"{number}\n")
        if log.read_text().count("\n") in map(int, os.environ["DIES_AT"].split()):
            os._exit(9)
        return number**2

    squares = units.completed("numbers", ((n, n) for n in range(4)), count)
    (asked.out / "counting.md").write_text(f"# Squares\n\n{squares}\n", encoding="utf-8")
    return int(os.environ.get("GATE", "0"))


if __name__ == "__main__":
    sys.exit(main())
