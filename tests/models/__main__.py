"""Write the six kinds of models that other people bring: ``python -m tests.models FOLDER``."""

import shutil
import sys
from pathlib import Path

from tests.models import bracket, folded_shell, free_bar, loose_part, tower, truss_deck

if __name__ == "__main__":
    folder = Path(sys.argv[1])
    written = [write.write(folder) for write in (free_bar, truss_deck, tower, folded_shell)]
    paths = [one.path for one in written] + [loose_part.write(folder)]
    if shutil.which("ccx"):
        paths.append(bracket.write(folder).path)
    print(*paths, sep="\n")
