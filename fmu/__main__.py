"""Entry point of ``python -m fmu``, which runs the ``fmu`` command."""

from fmu.cli import main

if __name__ == "__main__":
    main(prog_name="fmu")
