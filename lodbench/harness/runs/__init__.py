"""Runs of methods over datasets: predictions, their evaluation, and what is left on disk."""
