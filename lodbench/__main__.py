"""`python -m lodbench`."""

import sys

from lodbench.cli import main

sys.exit(main())
