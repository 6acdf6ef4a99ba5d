"""Running a method over a dataset: from configured parts to a run folder."""

from lodbench.harness.run import Run, RunSettings, run_method

__all__ = ["Run", "RunSettings", "run_method"]
