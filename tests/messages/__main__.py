"""`python -m tests.messages update` writes what is said now to every mistake of the catalogue."""

import contextlib
import sys
import tempfile
from pathlib import Path

from tests.messages import catalogue, prepare, write

if sys.argv[1:] == ["update"]:
    with tempfile.TemporaryDirectory() as scratch:
        folder = prepare(Path(scratch).resolve() / "typed here")
        with contextlib.chdir(folder):
            write([command for command, _ in catalogue()], folder)
else:
    sys.exit(__doc__)
