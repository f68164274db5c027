"""Entry point of ``python -m fmu``, which runs the command ``fmu``."""

from fmu.cli import main

if __name__ == "__main__":
    main(prog_name="fmu")
