"""See README.md: `python -m experiments.budget`."""
