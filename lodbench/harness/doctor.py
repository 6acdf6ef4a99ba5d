"""What works on this machine, and what to install for the rest.

What may crash or hang is tried by ``python -m lodbench.harness.doctor NAME``. Nothing that needs a package is
imported at the top: where numpy itself is broken, this still has to say so.
"""

from __future__ import annotations

import json
import os
import platform
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from importlib import import_module
from importlib.metadata import PackageNotFoundError, distribution, version
from importlib.util import find_spec
from pathlib import Path

from packaging.requirements import Requirement

from lodbench.errors import LodbenchError, RenderingError
from lodbench.findings import OK, Check
from lodbench.plugins import KINDS, PlugIn, config_folders, installed, load_plugin, unreadable

ABSENT, BROKEN = "absent", "broken"

# A probe that has not answered by then hangs; the slowest compiles for a few seconds, on a loaded
# machine perhaps for ten times that.
_PROBE_TIMEOUT_S = 120.0

# Renderers, and whether they come with the base install.
RENDERER_TRIALS = {"silhouette": True, "reference": True, "raster": True, "pyrender": False, "open3d": False}
# Extras of those who work on lodbench, and the sum of the others.
_NOT_FOR_USERS = ("all", "docs", "test")
# Segmenters whose weights come with the base install.
NETWORKS = ("compact", "compact_instances", "efficient_unet")
# How the line begins that a trial answers with.
_ANSWER = '{"ok": '
# Between a plug-in's name and its package, which is named where two have one of that name.
PACKAGE_FOLLOWS = " of "
# What a check says of a part that is there and was not used.
_NOT_TRIED = "not tried (--thorough)"


def examine(is_thorough: bool = False, timeout_s: float = _PROBE_TIMEOUT_S) -> list[Check]:
    """Returns everything there is to know of this installation; takes a second.

    Args:
        is_thorough: Compile a function, draw with each renderer, apply each network and load each plug-in
            as well, each in a process of its own; takes half a minute of processor time.
        timeout_s: How long each trial in a process of its own may take.
    """
    checks = [*_machine(), *_packages(), *_folders()]
    checks += _tried(timeout_s) if is_thorough else _there(timeout_s)
    checks += _plugin_packages()
    order = ("machine", "packages", "extras", "folders", "renderers", "networks", "traps", "plug-ins")
    return sorted(checks, key=lambda check: order.index(check.section))


def _there(timeout_s: float) -> Iterator[Check]:
    """Yields what is there of what ``_tried`` tries."""
    # Whether compiled packages fit this machine only their import tells, which may crash.
    yield run_probe("machine", "imports", True, timeout_s)
    for name, is_base in RENDERER_TRIALS.items():
        if is_base or find_spec(name) is not None:
            yield Check("renderers", name, OK, f"installed, {_NOT_TRIED}", is_base=is_base)
        else:
            hint = "pip install 'lodbench[render]'"
            yield Check("renderers", name, ABSENT, "is not installed", hint)
    weights = Path(__file__).parents[1] / "segmentation" / "weights"
    for name in NETWORKS:
        is_there = (weights / f"{name}.onnx").is_file()
        status, detail = (OK, f"installed, {_NOT_TRIED}") if is_there else (BROKEN, "has no weights")
        yield Check("networks", name, status, detail, "" if is_there else "Reinstall lodbench.", is_base=True)
    for name, plug_in in _plugins_of_others():
        of_package = f"of {plug_in.package}: {plug_in.point.value}"
        detail = plug_in.fault or f"{of_package}, {_NOT_TRIED}"
        yield Check("plug-ins", name, BROKEN if plug_in.fault else OK, detail)


def _tried(timeout_s: float) -> list[Check]:
    """Returns how everything went that may be used, each tried in a process of its own."""
    trials = [("machine", "numba", True)]
    trials += [("renderers", name, is_base) for name, is_base in RENDERER_TRIALS.items()]
    trials += [("networks", name, True) for name in NETWORKS]
    if find_spec("torch") and find_spec("torchvision"):
        trials.append(("traps", "torchvision", False))
    trials += [("plug-ins", name, False) for name, _ in _plugins_of_others()]
    with ThreadPoolExecutor(_cores()) as pool:
        return list(pool.map(lambda trial: run_probe(trial[0], trial[1], trial[2], timeout_s), trials))


def _plugins_of_others() -> list[tuple[str, PlugIn]]:
    """Returns the plug-ins of other packages, each with the name of the trial that loads it."""
    others = [plug_in for group in KINDS for plug_in in installed(group) if not plug_in.is_ours]
    names = [f"{KINDS[plug_in.group].label} {plug_in.name}" for plug_in in others]
    return [
        (f"{name}{PACKAGE_FOLLOWS}{plug_in.package}" if names.count(name) > 1 else name, plug_in)
        for name, plug_in in zip(names, others, strict=True)
    ]


def _plugin_packages() -> Iterator[Check]:
    """Yields what is wrong with packages of plug-ins as a whole."""
    for line in unreadable():
        yield Check("plug-ins", "metadata", BROKEN, line, "Install that package again.")
    for package, module, folder in config_folders():
        if folder is None:
            yield Check("plug-ins", "configuration", BROKEN, f"{package}: there is no {module}")


def is_base_broken(checks: list[Check]) -> bool:
    """Tells whether anything fails that lodbench cannot do without."""
    return any(check.is_base and check.status != OK for check in checks)


def run_probe(section: str, name: str, is_base: bool, timeout_s: float) -> Check:
    """Returns how a trial went in a process of its own: a driver's crash takes only that down."""
    command = [sys.executable, "-m", "lodbench.harness.doctor", name]
    try:
        done = subprocess.run(  # noqa: S603
            command, capture_output=True, text=True, errors="replace", timeout=timeout_s
        )
    except subprocess.TimeoutExpired:
        return Check(section, name, BROKEN, f"gave no answer within {timeout_s:.0f} s", "", is_base)
    # Libraries speak before it, and on their way out.
    lines = [line for line in done.stdout.splitlines() if line.startswith(_ANSWER)]
    if done.returncode != 0 or not lines:
        return Check(section, name, BROKEN, _end_of(done.returncode, done.stderr), "", is_base)
    answer = json.loads(lines[-1])
    status = OK if answer["ok"] else BROKEN
    if status == BROKEN and section == "renderers" and not is_base and find_spec(name) is None:
        status = ABSENT
    return Check(section, name, status, answer["detail"], answer["hint"], is_base)


def _end_of(code: int, errors: str) -> str:
    if code < 0:
        return f"crashed ({signal.Signals(-code).name})"
    lines = errors.strip().splitlines()
    return f"ended with code {code}: {lines[-1] if lines else 'no message'}"


def _machine() -> Iterator[Check]:
    is_supported = (3, 11) <= sys.version_info[:2] <= (3, 13)
    yield Check(
        "machine",
        "Python",
        OK if is_supported else BROKEN,
        platform.python_version(),
        "" if is_supported else "Use Python 3.11, 3.12 or 3.13.",
        is_base=True,
    )
    yield Check("machine", "system", OK, f"{platform.system()} {platform.machine()}, {_cores()} cores")


def _packages() -> Iterator[Check]:
    """Yields a check per package of the base install, and one per extra."""
    try:
        requirements = [Requirement(text) for text in distribution("lodbench").requires or []]
    except PackageNotFoundError:
        hint = "pip install -e . in the checkout, or pip install lodbench."
        yield Check("packages", "lodbench", BROKEN, "is not installed", hint, is_base=True)
        return
    for requirement in requirements:
        if _is_wanted(requirement, ""):
            fault = _fault(requirement)
            hint = f"pip install '{requirement}'" if fault else ""
            state = fault or version(requirement.name)
            yield Check("packages", requirement.name, BROKEN if fault else OK, state, hint, is_base=True)
    for extra in distribution("lodbench").metadata.get_all("Provides-Extra") or []:
        if extra in _NOT_FOR_USERS:
            continue
        wanted = _wanted_by(extra, requirements)
        faults = {r.name: fault for r in wanted if (fault := _fault(r))}
        detail = ", ".join(f"{name} {fault}" for name, fault in faults.items())
        hint = f"pip install 'lodbench[{extra}]'" if faults else ""
        yield Check("extras", extra, ABSENT if faults else OK, detail or "complete", hint)


def _wanted_by(extra: str, requirements: list[Requirement]) -> list[Requirement]:
    """Returns what an extra adds to the base; an extra of extras, as ``all``, what these add."""
    own = [r for r in requirements if _is_wanted(r, extra) and not _is_wanted(r, "")]
    inner = [
        part
        for r in own
        if r.name == "lodbench"
        for name in sorted(r.extras)
        for part in _wanted_by(name, requirements)
    ]
    return [r for r in own if r.name != "lodbench"] + inner


def _is_wanted(requirement: Requirement, extra: str) -> bool:
    return requirement.marker is None or requirement.marker.evaluate({"extra": extra})


def _fault(requirement: Requirement) -> str:
    """Returns what is wrong with a required package, or nothing."""
    try:
        installed_version = version(requirement.name)
    except PackageNotFoundError:
        return "is not installed"
    if requirement.specifier.contains(installed_version, prereleases=True):
        return ""
    return f"is {installed_version}, not {requirement.specifier}"


def _folders() -> Iterator[Check]:
    try:
        from lodbench.storage.paths import cache_root, data_root
    except ImportError as error:
        yield Check("folders", "data, cache", BROKEN, f"cannot be queried: {error}", is_base=True)
        return
    for name, folder, variable in (
        ("data", data_root(), "LODBENCH_DATA"),
        ("cache", cache_root(), "LODBENCH_CACHE"),
    ):
        ground = next(path for path in (folder, *folder.absolute().parents) if path.exists())
        can_write = ground.is_dir() and os.access(ground, os.W_OK | os.X_OK)
        hint = "" if can_write else f"Set {variable} to a folder you may write to."
        detail = f"{folder}" if can_write else f"{folder} cannot be written to"
        yield Check("folders", name, OK if can_write else BROKEN, detail, hint, is_base=True)


def _cores() -> int:
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def try_imports() -> str:
    """Imports the compiled packages of the base install; returns what there is to say."""
    names = ("numba", "scipy", "cv2", "lxml.etree", "pyproj", "shapely", "mapbox_earcut", "xxhash")
    for name in names:
        import_module(name)
    return "the compiled packages load"


def try_numba() -> str:
    """Compiles a function; returns what there is to say."""
    import numba
    import numpy as np

    # No cache: the compiler itself is to be seen at work.
    function = numba.njit(lambda values: (values * values).sum())
    if function(np.arange(4.0)) != 14.0:
        raise LodbenchError("A compiled function gives a wrong result.", "Reinstall numba and llvmlite.")
    return f"compiles, with numba {numba.__version__}"


def try_renderer(name: str) -> str:
    """Draws a tower and compares it with the reference; returns what there is to say."""
    import numpy as np

    from lodbench.citymodel.extrude import scene_of_blocks
    from lodbench.geometry import Camera, EulerAngles, Pose
    from lodbench.rendering import open_renderer
    from lodbench.rendering.backends import trust_driver

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
    """Applies a network of the package to a drawn roof; returns what there is to say."""
    import numpy as np

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
            f"torchvision {version('torchvision')} does not fit torch {torch.__version__} ({error}).",
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


if __name__ == "__main__":
    main(sys.argv[1])
