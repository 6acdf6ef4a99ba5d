"""lodbench: where was the camera? City models, silhouettes, and a benchmark for aerial localisation.

The public names below load on first use, so that importing the package costs nothing.
"""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import Any

__version__ = "0.2.0"

# Public name -> module that defines it.
_PUBLIC = {
    "Camera": "lodbench.geometry",
    "EulerAngles": "lodbench.geometry",
    "LodLocV2": "lodbench.methods.lodlocv2",
    "LodbenchError": "lodbench.errors",
    "Pose": "lodbench.geometry",
    "QueryFault": "lodbench.errors",
    "Scene": "lodbench.citymodel.scene",
    "compare": "lodbench.harness.results",
    "leaderboard": "lodbench.harness.results",
    "load_run": "lodbench.harness.results",
    "localize": "lodbench.methods.localize",
    "localize_flight": "lodbench.cli.localize",
    "localize_photo": "lodbench.cli.localize",
    "locate": "lodbench.citymap.places",
    "make_renderer": "lodbench.rendering",
    "open_scene": "lodbench.citymodel",
    "pose_error": "lodbench.evaluation",
    "read_mask": "lodbench.segmentation.masks",
    "read_poses": "lodbench.datasets.pose_text",
    "run_method": "lodbench.harness.results",
}
__all__ = ["__version__", *sorted(_PUBLIC)]

# In an uninstalled checkout `baselines/` and `conf/` lie beside the package, not inside it.
if not (Path(__file__).parent / "conf").is_dir():
    __path__.append(str(Path(__file__).parent.parent))


def __getattr__(name: str) -> Any:
    if name not in _PUBLIC:
        raise AttributeError(f"module 'lodbench' has no attribute {name!r}")
    return getattr(import_module(_PUBLIC[name]), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *_PUBLIC})
