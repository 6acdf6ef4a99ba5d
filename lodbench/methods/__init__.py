"""Methods: from a query and a map to a pose. The paper's and lodbench's own; others' are in ``baselines``.

``protocol`` says what a method is, ``registry`` finds it by name, ``measured_calls`` asks it for poses,
``workspace`` keeps what it prepares, ``conformance`` checks it. ``tracking`` is no method but what
``lodbench track`` does.
"""

from lodbench.datasets.inputs import Input
from lodbench.methods.protocol import Estimate, Method, Streams

__all__ = ["Estimate", "Input", "Method", "Streams"]
