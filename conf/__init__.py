"""Hydra configuration of lodbench: names and numbers, no code."""
