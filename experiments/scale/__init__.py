"""See README.md: `python -m experiments.scale`."""
