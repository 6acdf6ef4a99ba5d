"""What works on this machine, and what to install for the rest.

Nothing of lodbench that needs a package is imported at the top: where numpy itself is broken, this still
has to say so.
"""

from __future__ import annotations

import json
import os
import platform
import signal
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from importlib.metadata import PackageNotFoundError, distribution, version
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

from packaging.requirements import Requirement

from lodbench.checks import OK, Check

if TYPE_CHECKING:
    from lodbench.plugins import PlugIn

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
        is_thorough: Compile a function, draw with each renderer, ask each network and load each plug-in
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
    from lodbench.plugins import KINDS, installed

    others = [plug_in for group in KINDS for plug_in in installed(group) if not plug_in.is_ours]
    names = [f"{KINDS[plug_in.group].label} {plug_in.name}" for plug_in in others]
    return [
        (f"{name}{PACKAGE_FOLLOWS}{plug_in.package}" if names.count(name) > 1 else name, plug_in)
        for name, plug_in in zip(names, others, strict=True)
    ]


def _plugin_packages() -> Iterator[Check]:
    """Yields what is wrong with packages of plug-ins as a whole."""
    from lodbench.plugins import config_folders, unreadable

    for line in unreadable():
        yield Check("plug-ins", "metadata", BROKEN, line, "Install that package again.")
    for package, module, folder in config_folders():
        if folder is None:
            yield Check("plug-ins", "configuration", BROKEN, f"{package}: there is no {module}")


def is_base_broken(checks: list[Check]) -> bool:
    """Tells whether anything fails that lodbench cannot do without."""
    return any(check.is_base and check.status != OK for check in checks)


def run_probe(section: str, name: str, is_base: bool, timeout_s: float) -> Check:
    """Returns how a trial of ``lodbench.harness.doctor_probes`` went in a process of its own."""
    command = [sys.executable, "-m", "lodbench.harness.doctor_probes", name]
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
    """Returns how a process ended, in words."""
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
            found = fault or version(requirement.name)
            yield Check("packages", requirement.name, BROKEN if fault else OK, found, hint, is_base=True)
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
        found = version(requirement.name)
    except PackageNotFoundError:
        return "is not installed"
    if requirement.specifier.contains(found, prereleases=True):
        return ""
    return f"is {found}, not {requirement.specifier}"


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
    """Returns how many cores this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
