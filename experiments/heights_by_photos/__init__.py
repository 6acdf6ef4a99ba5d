"""See README.md: `python -m experiments.heights_by_photos`."""
