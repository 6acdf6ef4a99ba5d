"""See README.md: `python -m experiments.city_make`."""
