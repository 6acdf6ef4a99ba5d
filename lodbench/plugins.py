"""Plug-ins: whatever an outsider may add is an entry point, found by its name and loaded when it is chosen.

Built-in parts are entry points too. A package that is broken harms who chooses it and nobody else: nothing
is imported before, and a name that lodbench has itself stays lodbench's. ``docs/plugins.md`` has an example
of every kind. Files of configuration lie beside them, in lodbench's package and in others'.
"""

from __future__ import annotations

import os
import sys
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import lru_cache
from importlib.metadata import Distribution, EntryPoint, distributions
from importlib.util import find_spec
from pathlib import Path
from typing import Any, TypeVar

from lodbench.errors import STOPPED, ConfigError, LodbenchError, nearest_names

T = TypeVar("T")

_OURS = "lodbench"
_CONFIG_GROUP = "lodbench.config_sources"


@dataclass(frozen=True, slots=True)
class Kind:
    """A kind of plug-in.

    Attributes:
        label: What one is called, also by ``lodbench check-plugin``.
        members: What the class or function that an entry point names must have.
    """

    label: str
    members: tuple[str, ...] = ()


# By group: methods are entry points of the group ``lodbench.methods``.
KINDS = {
    "methods": Kind("method", ("name", "params_type", "localize")),
    "segmenters": Kind("segmenter", ("params_type", "fingerprint")),
    "feature_extractors": Kind("feature-extractor", ("params_type", "extract")),
    "matchers": Kind("matcher", ("params_type", "match")),
    "retrievals": Kind("retrieval", ("params_type", "describe")),
    "pose_solvers": Kind("pose-solver", ("params_type", "solve")),
    "datasets": Kind("dataset"),
    "priors": Kind("prior", ("name", "apply", "describe")),
    "pose_formats": Kind("pose-format"),
    "export_formats": Kind("export-format", ("file_name", "requires", "write")),
    "city_readers": Kind("city-reader"),
    "renderers": Kind("renderer", ("name", "render")),
    "fits": Kind("fit"),
    "metrics": Kind("metric"),
    "commands": Kind("command"),
}


@dataclass(frozen=True, slots=True)
class PlugIn:
    """An entry point, not loaded.

    Attributes:
        group: A key of ``KINDS``.
        name: Its name, as in ``method=NAME``.
        package: The package that offers it, with its version.
        point: The entry point.
        fault: Why it cannot be used, as far as that shows without loading it; empty where nothing does.
    """

    group: str
    name: str
    package: str
    point: EntryPoint
    fault: str = ""

    @property
    def is_ours(self) -> bool:
        """Whether it comes with lodbench."""
        return self.package.split(" ")[0] == _OURS

    def load(self) -> Any:
        """Returns the class or function that the entry point names.

        Raises:
            ConfigError: It cannot be imported, or is not what plug-ins of its kind are.
        """
        if self.fault:
            raise self._broken(self.fault)
        try:
            part = self.point.load()
        except STOPPED:
            raise
        except BaseException as error:  # a package of others may raise anything
            raise self._broken(
                f"{self.point.value} does not load: {_words(error, self.point.module)}"
            ) from error
        if not callable(part):
            raise self._broken(
                f"{self.point.value} is no class or function, but of type {type(part).__name__}"
            )
        lacking = [member for member in KINDS[self.group].members if not hasattr(part, member)]
        if lacking:
            raise self._broken(f"{self.point.value} has no {' and no '.join(lacking)}")
        return part

    def _broken(self, reason: str) -> ConfigError:
        label = KINDS[self.group].label
        return ConfigError(
            f"The {label} {self.name!r} of the package {self.package} is broken: {reason}.",
            f"See docs/plugins.md, and lodbench check-plugin {label} {self.name}.",
        )


def find_plugin(group: str, name: str) -> PlugIn:
    """Returns a plug-in, not loaded.

    Raises:
        ConfigError: No installed package offers it.
    """
    for plug_in in installed(group):
        if plug_in.name == name:
            return plug_in
    hint = nearest_names(name, plugin_names(group))
    if not any(plug_in.is_ours for plug_in in installed(group)):
        hint = f"{hint} Those of lodbench are not installed: pip install -e . in the checkout.".strip()
    raise ConfigError(f"There is no {KINDS[group].label} {name!r}.", hint)


def load_plugin(group: str, name: str) -> Any:
    """Returns the class or function that a plug-in is; arguments as for ``find_plugin``.

    Raises:
        ConfigError: No installed package offers it, or it is broken.
    """
    return find_plugin(group, name).load()


def plugin_names(group: str) -> tuple[str, ...]:
    """Returns the names of all plug-ins of a group: lodbench's own first, each part by the alphabet."""
    return tuple(dict.fromkeys(plug_in.name for plug_in in installed(group)))


def installed(group: str) -> tuple[PlugIn, ...]:
    """Returns the plug-ins of a group, lodbench's own first."""
    return tuple(plug_in for plug_in in _scan(_state())[0] if plug_in.group == group)


def unreadable() -> tuple[str, ...]:
    """Returns a line for each package whose entry points cannot be read."""
    return _scan(_state())[1]


def config_folders() -> tuple[tuple[str, str, Path | None], ...]:
    """Returns package, module name and folder of every ``conf`` there is, lodbench's own first.

    The folder is None where there is none, or where looking for it fails.
    """
    return tuple((package, point.value, _folder_of(point)) for package, point in _scan(_state())[2])


def _folder_of(point: EntryPoint) -> Path | None:
    """Returns the folder of a package, found without importing anything where pip has copied it."""
    if point.dist is not None:
        folder = Path(str(point.dist.locate_file(point.value.replace(".", "/"))))
        if folder.is_dir():
            return folder
    try:
        spec = find_spec(point.value)
    except STOPPED:
        raise
    except BaseException:  # it imports the package around, which may raise anything
        return None
    places = list(spec.submodule_search_locations or ()) if spec else []
    return Path(places[0]) if places else None


_Scan = tuple[tuple[PlugIn, ...], tuple[str, ...], tuple[tuple[str, EntryPoint], ...]]


@lru_cache(maxsize=8)
def _scan(_: tuple[tuple[str, float], ...]) -> _Scan:
    """Returns all plug-ins, packages that cannot be read, and folders of configuration."""
    plug_ins: list[PlugIn] = []
    faults: list[str] = []
    folders: list[tuple[str, EntryPoint]] = []
    for package, points in _packages(faults):
        for point in points:
            if point.group == _CONFIG_GROUP:
                folders.append((package, point))
            elif point.group.removeprefix("lodbench.") in KINDS:
                plug_ins.append(PlugIn(point.group.removeprefix("lodbench."), point.name, package, point))
    plug_ins.sort(key=lambda plug_in: (not plug_in.is_ours, plug_in.name, plug_in.package))
    folders.sort(key=lambda item: (item[0].split(" ")[0] != _OURS, item[0]))
    return tuple(_with_clashes(plug_ins)), tuple(faults), tuple(folders)


def _packages(faults: list[str]) -> Iterator[tuple[str, list[EntryPoint]]]:
    """Yields packages that have entry points of lodbench's, each once, as on the path of imports."""
    names = set()
    for distribution in distributions():
        try:
            # Most packages have none: reading the metadata of all would take a tenth of a second.
            if "lodbench." not in (distribution.read_text("entry_points.txt") or ""):
                continue
            name = distribution.metadata["Name"]
            if name in names:
                continue
            names.add(name)
            package = f"{name} {distribution.version}"
            yield package, [point for point in distribution.entry_points if point.group.startswith(_OURS)]
        except Exception as error:  # damaged metadata of one package is no fault of the others
            faults.append(f"{_place(distribution)}: its entry points cannot be read: {_words(error)}")


def _place(distribution: Distribution) -> str:
    return str(distribution.locate_file(""))


def _with_clashes(plug_ins: list[PlugIn]) -> Iterator[PlugIn]:
    """Yields plug-ins, the fault of those whose name lodbench or another package has as well with them."""
    for plug_in in plug_ins:
        others = [p.package for p in plug_ins if (p.group, p.name) == (plug_in.group, plug_in.name)]
        others.remove(plug_in.package)
        is_fault = others and not plug_in.is_ours
        yield replace(plug_in, fault=f"{' and '.join(others)} has one of that name") if is_fault else plug_in


def _state() -> tuple[tuple[str, float], ...]:
    """Returns the path of imports, and when its folders were changed last."""
    return tuple((path, _modified(path or ".")) for path in sys.path)


def _modified(path: str) -> float:
    try:
        return os.stat(path).st_mtime  # noqa: PTH116 - asked at every look-up, at a fifth of the cost
    except OSError:
        return 0.0


@contextmanager
def blaming(group: str, name: str, what: str) -> Iterator[None]:
    """Tells in one line what a plug-in's code raises, and where; errors of lodbench and its own parts pass.

    Those of the operating system that name a file pass, too: the command line tells them.

    Args:
        group: A key of ``KINDS``.
        name: The plug-in's.
        what: What it cannot do then: ``be made``.

    Raises:
        ConfigError: Its code raised something.
    """
    try:
        yield
    except (LodbenchError, *STOPPED):
        raise
    except BaseException as error:  # code of others may raise anything
        plug_in = next((each for each in installed(group) if each.name == name), None)
        names_file = isinstance(error, OSError) and error.filename is not None
        if names_file or isinstance(error, BrokenPipeError) or (plug_in is not None and plug_in.is_ours):
            raise
        label, module = KINDS[group].label, plug_in.point.module if plug_in else ""
        package = f" of the package {plug_in.package}" if plug_in else ""
        raise ConfigError(
            f"The {label} {name!r}{package} cannot {what}: {_words(error, module)}.",
            f"See lodbench check-plugin {label} {name}.",
        ) from error


def of_kind(made: object, wanted: type[T]) -> T:
    """Returns what a plug-in made.

    Raises:
        TypeError: It is something else.
    """
    if not isinstance(made, wanted):
        raise TypeError(f"{type(made).__name__} came out instead of {wanted.__name__}")
    return made


def _words(error: BaseException, module: str = "") -> str:
    """Returns an exception in one line, with the last place in the package of a module that led to it."""
    text = str(error).splitlines()
    top = module.partition(".")[0]
    frames = [
        frame
        for frame in traceback.extract_tb(error.__traceback__)
        if top in Path(frame.filename).with_suffix("").parts
    ]
    where = f" ({frames[-1].filename}, line {frames[-1].lineno})" if frames else ""
    return f"{type(error).__name__}: {text[0] if text else 'no message'}{where}"


def config_files(group: str, ending: str = ".yaml") -> dict[str, Path]:
    """Returns the files of a group such as ``source`` by name; lodbench's own go before those of plug-ins."""
    files: dict[str, Path] = {}
    for _, _, folder in config_folders():
        for file in sorted((folder / group).glob(f"*{ending}")) if folder is not None else ():
            files.setdefault(file.name.removesuffix(ending), file)
    return files
