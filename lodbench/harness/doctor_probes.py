"""Trials that may crash or hang: `python -m lodbench.harness.doctor_probes NAME` tries one, says how.

`lodbench doctor` runs each in a process of its own, so that a driver's crash takes only that down, and
imports no more than it tries.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from functools import partial
from importlib import import_module

import numpy as np

from lodbench.errors import LodbenchError, RenderingError
from lodbench.harness.doctor import NETWORKS, PACKAGE_FOLLOWS, RENDERER_TRIALS
from lodbench.plugins import KINDS, installed, load_plugin


def try_imports() -> str:
    """Imports the compiled packages of the base install; returns what there is to say."""
    names = ("numba", "scipy", "cv2", "lxml.etree", "pyproj", "shapely", "mapbox_earcut", "xxhash")
    for name in names:
        import_module(name)
    return "the compiled packages load"


def try_numba() -> str:
    """Compiles a function; returns what there is to say."""
    import numba

    # No cache: the compiler itself is to be seen at work.
    function = numba.njit(lambda values: (values * values).sum())
    if function(np.arange(4.0)) != 14.0:
        raise LodbenchError("A compiled function gives a wrong result.", "Reinstall numba and llvmlite.")
    return f"compiles, with numba {numba.__version__}"


def try_renderer(name: str) -> str:
    """Draws a tower and compares it with the reference; returns what there is to say."""
    from lodbench.citymodel.extrude import scene_of_blocks
    from lodbench.geometry import Camera, EulerAngles, Pose
    from lodbench.rendering import open_renderer
    from lodbench.rendering.drivers import trust_driver

    trust_driver()
    scene = scene_of_blocks([(-6.0, -6.0, 6.0, 6.0, 0.0, 25.0)])
    camera = Camera(160, 120, 110.0, 105.0, 83.0, 58.0)
    pose = Pose.from_euler(EulerAngles(35.0, 1.0, 20.0), (0.0, -20.0, 40.0))
    drawn = open_renderer(name, scene, 1).render(camera, pose)
    expected = open_renderer("reference", scene, 1).render(camera, pose)
    share = float(np.mean(drawn != expected))
    if not drawn.any() or share > 0.01:
        raise RenderingError(
            f"{name} draws something else than the reference: {100 * share:.2f} % of the pixels differ.",
            "Please report this machine's driver and versions.",
        )
    return "ok, identical to the reference" if share == 0 else f"ok, {100 * share:.2f} % of pixels differ"


def try_network(name: str) -> str:
    """Asks a network of the package about a drawn roof; returns what there is to say."""
    network = load_plugin("segmenters", name)
    photo = np.full((96, 128, 3), (70, 110, 60), np.uint8)
    photo[24:72, 32:96] = (170, 80, 60)
    logits = network(network.params_type()).logits(photo)
    if logits.ndim != 2 or not np.isfinite(logits).all() or not np.ptp(logits) > 0:
        raise LodbenchError(f"{name} gives no answer.", "Reinstall opencv-python-headless.")
    return "ok"


def try_torchvision() -> str:
    """Imports torchvision beside torch; returns what there is to say."""
    import torch

    try:
        import torchvision
    except RuntimeError as error:
        # Built against another torch, it fails with no ImportError, which fools those that guard for one.
        raise LodbenchError(
            f"torchvision {_version('torchvision')} does not fit torch {torch.__version__} ({error}).",
            "pip uninstall torchvision (lodbench does not need it), or install both from one index: "
            "pip install torch torchvision --index-url https://download.pytorch.org/whl/cpu",
        ) from error
    return f"{torchvision.__version__} loads beside torch {torch.__version__}"


def try_plugin(kind: str, name: str, package: str = "") -> str:
    """Loads a plug-in, of a package where two have one of that name; returns whose it is."""
    group = next(group for group, known in KINDS.items() if known.label == kind)
    others = [p for p in installed(group) if p.name == name and not p.is_ours]
    plug_in = next(p for p in others if package in ("", p.package))
    plug_in.load()
    return f"of {plug_in.package}: {plug_in.point.value}"


PROBES: dict[str, Callable[[], str]] = {
    "imports": try_imports,
    "numba": try_numba,
    "torchvision": try_torchvision,
    **{name: partial(try_renderer, name) for name in RENDERER_TRIALS},
    **{name: partial(try_network, name) for name in NETWORKS},
}


def main(name: str) -> None:
    """Tries one thing and writes one line of JSON: ok, detail, hint."""
    try:
        kind, _, rest = name.partition(" ")
        plug_in, _, package = rest.partition(PACKAGE_FOLLOWS)
        detail = try_plugin(kind, plug_in, package) if plug_in else PROBES[name]()
        answer = {"ok": True, "detail": detail, "hint": ""}
    except LodbenchError as error:
        answer = {"ok": False, "detail": error.message, "hint": error.hint}
    except Exception as error:  # whatever a driver raises is the answer
        answer = {"ok": False, "detail": f"{type(error).__name__}: {error}", "hint": ""}
    # A line of its own: libraries write to standard output as they please.
    sys.stdout.write("\n" + json.dumps(answer) + "\n")


def _version(name: str) -> str:
    from importlib.metadata import version

    return version(name)


if __name__ == "__main__":
    main(sys.argv[1])
