"""Questions that were answered once, each a folder with its write-up: `python -m experiments.NAME`."""
