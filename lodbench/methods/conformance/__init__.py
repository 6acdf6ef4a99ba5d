"""Whether a method conforms to the protocol: its class, and its answers to a small trial."""

from lodbench.methods.conformance.check import check_answers, check_class, trial_settings

__all__ = ["check_answers", "check_class", "trial_settings"]
