"""See README.md: `python -m experiments.reconstructions`."""
