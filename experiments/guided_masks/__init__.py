"""See README.md: `python -m experiments.guided_masks`."""
