"""What a run's numbers depend on: its queries, its code, and what its method reads and prepares."""

from __future__ import annotations

import inspect
import linecache
import re
import sys
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import astuple, replace
from importlib.metadata import Distribution, PackageNotFoundError, distribution, packages_distributions
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import urlparse
from urllib.request import url2pathname

from lodbench.citymap import CityMap
from lodbench.datasets.inputs import Input, declared_inputs
from lodbench.datasets.query import Dataset, Entry, Reference, repeated_keys
from lodbench.errors import STOPPED, ConfigError, DatasetError, LodbenchError
from lodbench.evaluation.predictions import pose_numbers
from lodbench.execution.processes import single_threaded_blas, staying_here
from lodbench.harness.tracebacks import keep_traceback, words_of
from lodbench.methods import Method
from lodbench.methods.localize import weight_files
from lodbench.methods.protocol import SupportsFlights, SupportsPrepare, open_workspace
from lodbench.plugins import KINDS, installed
from lodbench.storage import digest_of, file_digest
from lodbench.storage.digest import content_digest, own_digest, package_files
from lodbench.storage.json_text import parse_json

if TYPE_CHECKING:
    pass
_OURS = "lodbench"
# The name that a requirement begins with.
_NAME = re.compile(r"\w[\w.-]*")
# What a workspace's content depends on, of a run's inputs.
_PREPARED_FROM = ("scene", "roofs", "code", "weights", "references", "textured_map")


def chosen_entries(dataset: Dataset, splits: tuple[str, ...], limit: int | None) -> tuple[Entry, ...]:
    """Returns the entries of some splits, at most ``limit`` of each, in file order by split.

    Raises:
        DatasetError: Two have one key: one would count twice and the other never.
    """
    by_split = [[entry for entry in dataset.entries if entry.split == split] for split in splits]
    twice = repeated_keys(entry for entries in by_split for entry in entries)
    if twice:
        raise DatasetError(
            f"The dataset {dataset.name} has several queries {twice[0]}.",
            "Give each query of a split a name of its own.",
        )
    return tuple(entry for entries in by_split for entry in entries[:limit])


def queries_digest(dataset: Dataset, entries: tuple[Entry, ...]) -> str:
    """Returns a digest of some entries: names, cameras and how well these are known, priors, truth."""
    return digest_of(
        [
            [
                entry.key,
                repr(entry.camera),
                pose_numbers(entry.prior),
                pose_numbers(dataset.truth.get(entry.key)),
                *([] if entry.lens_percent is None else [entry.lens_percent]),
                *([] if entry.camera_sigmas is None else astuple(entry.camera_sigmas)),
                *([] if entry.measured is None else entry.measured.words()),
            ]
            for entry in entries
        ]
    )


def flights_digest(entries: tuple[Entry, ...]) -> str | None:
    """Returns a digest of what ties photos together: flights and reconstructions; None where nothing does."""
    tied = [e for e in entries if e.sequence or e.reconstructed is not None]
    return digest_of([[e.key, e.sequence, pose_numbers(e.reconstructed)] for e in tied]) if tied else None


def truth_digest(dataset: Dataset, entries: tuple[Entry, ...]) -> str:
    """Returns a digest of the true poses of some entries: what an oracle is shown."""
    return digest_of([[entry.key, pose_numbers(dataset.truth.get(entry.key))] for entry in entries])


def split_digest(entries: tuple[Entry, ...]) -> str:
    """Returns a digest of which queries are scored, in which splits."""
    return digest_of([entry.key for entry in entries])


def code_digest(*parts: object, names: Collection[object] = ()) -> str:
    """Returns a digest of lodbench's own code, of the libraries that compute, and of others' packages.

    Of what these require the versions count, and the files of what is edited in place.

    Args:
        parts: A method, a segmenter: the packages that define them count in whole; and what one that runs
            elsewhere says of its code there, ``remote_code``.
        names: What settings are, of which some may name plug-ins: the packages of those count in, too.

    Raises:
        ConfigError: A part was defined where its code cannot be read.
    """
    elsewhere = [list(getattr(part, "remote_code", ())) for part in parts if hasattr(part, "remote_code")]
    named = [each for group in KINDS for each in installed(group) if not each.is_ours and each.name in names]
    modules = {type(part).__module__ for part in parts} | {each.point.module for each in named}
    packages = {module.partition(".")[0] for module in modules} - {_OURS, "__main__"}
    required = required_by(packages)
    files = [file_digest(file) for package in sorted(packages) for file in package_files(package)]
    # What is edited in place keeps its version.
    files += [file_digest(file) for each in sorted(required, key=_name_of) for file in _edited_files(each)]
    versions = sorted(f"{each.name}=={each.version}" for each in required)
    typed = [_typed_code(part) for part in parts if type(part).__module__ == "__main__"]
    return digest_of([own_digest(), files, *typed, *elsewhere, *([versions] if versions else [])])


def required_by(packages: Collection[str]) -> list[Distribution]:
    """Returns the distributions that those of some packages require, and what these require, as installed.

    Without lodbench, and what is required for extras alone.
    """
    offered = packages_distributions() if packages else {}
    waiting = [name for package in packages for name in offered.get(package, ())]
    read = set(waiting)
    by_name: dict[str, Distribution] = {}
    while waiting:
        name = waiting.pop()
        plain = re.sub(r"[-_.]+", "-", name).lower()
        if plain in by_name or plain == _OURS:
            continue
        try:
            by_name[plain] = distribution(name)
        except PackageNotFoundError:
            continue
        needs = [text for text in by_name[plain].requires or () if "extra" not in text.partition(";")[2]]
        waiting += [match[0] for match in map(_NAME.match, needs) if match]
    # The packages themselves count by their files.
    return [each for each in by_name.values() if each.name not in read]


def _name_of(package: Distribution) -> str:
    return package.name


def _edited_files(package: Distribution) -> list[Path]:
    """Returns the Python files of a package that is installed to be edited (PEP 610), else none."""
    try:
        reported = parse_json(_read(package, "direct_url.json") or "{}")
        is_editable = reported["dir_info"]["editable"] is True
        folder = Path(url2pathname(urlparse(reported["url"]).path))
    except (ValueError, KeyError, TypeError):
        return []
    if not is_editable:
        return []
    names = _read(package, "top_level.txt").split()
    if names:
        return [file for name in names for file in package_files(name)]
    # Not every builder says which packages it holds: all there is, but environments in it.
    candidates = ((file, file.relative_to(folder).parts) for file in folder.rglob("*.py"))
    return sorted(
        file for file, parts in candidates if "site-packages" not in parts and not parts[0].startswith(".")
    )


def _read(package: Distribution, name: str) -> str:
    return package.read_text(name) or ""


def words_in(settings: object) -> Iterator[str]:
    """Yields all words among settings, JSON values, of which some may name plug-ins."""
    if isinstance(settings, str):
        yield settings
    elif isinstance(settings, dict | list | tuple):
        for each in settings.values() if isinstance(settings, dict) else settings:
            yield from words_in(each)


def _typed_code(part: object) -> str:
    """Returns a digest of the script that defines a part, or of what was typed: in a notebook there is none.

    There all cells count that define a function or a class which is there still: the part may use any.
    """
    main = sys.modules["__main__"]
    script = getattr(main, "__file__", None)
    if script is not None and Path(script).is_file():
        return file_digest(Path(script))
    if not any(map(linecache.getlines, _cells_of(type(part)))):
        raise ConfigError(
            f"The code of {type(part).__name__} cannot be read, so its results could not be kept apart from "
            "those of another version.",
            "Define it in a file, and import it.",
        )
    cells = _cells_of(type(part)).union(*map(_cells_of, list(vars(main).values())))
    return digest_of(sorted("".join(linecache.getlines(cell)) for cell in cells))


def _cells_of(thing: object) -> set[str]:
    """Returns the names under which Python keeps the cells that a typed function or class stands in."""
    if getattr(thing, "__module__", None) != "__main__":
        return set()
    # Python finds the lines of a class by its module's file alone, of which a notebook has none.
    members = [*vars(thing).values()] if isinstance(thing, type) else [thing]
    plain = [getattr(each, "__func__", getattr(each, "fget", each)) for each in members]
    return {each.__code__.co_filename for each in plain if inspect.isfunction(each)}


def method_inputs(method: Method, dataset: Dataset, entries: Sequence[Entry]) -> dict[str, str]:
    """Returns digests of the weights, photos and references that a method uses; nothing for what it does not.

    Raises:
        ConfigError: A file of weights is missing.
    """
    requires = declared_inputs(method, "requires", {Input.MASK})
    weights = weight_files(method)
    inputs = {}
    if weights:
        inputs["weights"] = digest_of([content_digest(file) for file in weights])
    # Methods for flights look at photos where there are any; of the same photos all have the same digest.
    shown = [entry for entry in entries if entry.image is not None]
    if shown and (Input.IMAGE in requires or isinstance(method, SupportsFlights)):
        inputs["images"] = digest_of([[entry.key, content_digest(entry.image)] for entry in shown])
    if Input.REFERENCES in requires:
        inputs["references"] = digest_of([_identity(reference) for reference in dataset.references])
    return inputs


@staying_here()
def prepare_method(
    method: Method,
    params: object,
    inputs: Mapping[str, str],
    city_map: CityMap,
    references: Sequence[Reference],
    folder: Path,
) -> None:
    """Lets a method prepare, if it does, in the workspace of this content; a second time it finds it filled.

    Args:
        method: The method.
        params: Its parameters, as JSON values.
        inputs: Digests of the run's inputs.
        city_map: The map.
        references: Posed pictures in the dataset's frame.
        folder: The run's, for the traceback of a fault.

    Raises:
        LodbenchError: It cannot prepare: in the method's words, or, for a fault of its code, with the
            traceback's file.
    """
    if not isinstance(method, SupportsPrepare):
        return
    content = {name: inputs[name] for name in _PREPARED_FROM if name in inputs}
    workspace = open_workspace(method.name, digest_of([method.name, params, content]))
    local = [replace(r, pose=r.pose.shifted(-city_map.scene.origin)) for r in references]
    try:
        single_threaded_blas(method.prepare)(city_map, local, workspace)
    except (LodbenchError, *STOPPED):
        raise
    except BaseException as error:  # a plug-in's code may raise anything
        file = keep_traceback(folder, "prepare", error)
        raise ConfigError(
            f"method={method.name} cannot prepare: {words_of(error)}", f"See {file}."
        ) from error


def _identity(reference: Reference) -> list[object]:
    pose = [float(v) for v in reference.pose.cam_from_world[:3].ravel()]
    return [reference.name, repr(reference.camera), pose, content_digest(reference.image)]
