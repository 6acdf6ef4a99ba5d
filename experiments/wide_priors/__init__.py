"""See README.md: `python -m experiments.wide_priors`."""
