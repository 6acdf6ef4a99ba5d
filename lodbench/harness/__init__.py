"""Runs of methods over datasets; photos of one's own, exports, pictures of a city, the doctor.

==================  ================================================================================
use                 what
==================  ================================================================================
``runs``            ``lodbench run`` and all that reads a run: report, compare, verify, status
``photo``           ``lodbench localize``: photos and flights of one's own, and their pages
``georeference``    a reconstruction placed on the map
``track``           a video
``mask``            ``lodbench mask``: masks by strokes
``export``          poses and results for other programs
``render``          ``lodbench render``
``city``            opening the city of a command; one of many tiles
``conformance``     checks of plug-ins; ``doctor``: of this machine
``results``         runs as DataFrames
==================  ================================================================================

Names are loaded when first used: `lodbench doctor` lives here too, and must start where numpy does not.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from lodbench.lazy_names import lazy_names

if TYPE_CHECKING:
    from lodbench.harness.runs.artefacts import Run as Run
    from lodbench.harness.runs.run import RunSettings as RunSettings
    from lodbench.harness.runs.run import run_method as run_method

__all__, __getattr__, __dir__ = lazy_names(
    __name__, {"Run": "runs.artefacts", "RunSettings": "runs.run", "run_method": "runs.run"}
)
