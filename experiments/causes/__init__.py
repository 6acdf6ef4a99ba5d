"""See README.md: `python -m experiments.causes`."""
