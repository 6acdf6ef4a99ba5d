"""Does a plug-in keep to the protocol of its kind? Looked at rule by rule, on a scene of a few blocks."""

from lodbench.harness.conformance.checks import CHECKED, check_plugin

__all__ = ["CHECKED", "check_plugin"]
