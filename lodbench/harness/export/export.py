"""A run for other programs: what formats are given, and where they write."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from lodbench.citymodel.scene import Scene
from lodbench.datasets.exchange.posed import FoundPose
from lodbench.datasets.query import Dataset
from lodbench.errors import ConfigError, DatasetError
from lodbench.harness.runs.stored import StoredRun
from lodbench.plugins import blaming, load_plugin
from lodbench.storage import make_folder, scratch_folder
from lodbench.storage.disk import disk

# The first line of a table of queries has some 200 bytes.
_HEAD_BYTES = 4096
# What a format may require beside the run.
DATASET, CITY, CRS = "dataset", "city", "crs"


@dataclass(frozen=True, slots=True, eq=False)
class Export:
    """What a format is given; what it does not require may be None."""

    run: StoredRun
    dataset: Dataset | None = None
    city: Scene | None = None
    crs: str | None = None

    def poses(self) -> list[FoundPose]:
        """Returns the poses, named as their images if the run has one split, else as ``split/name``.

        Cameras are those of the dataset, where it is open.
        """
        names = self.run.queries["query"]
        if self.run.queries["split"].nunique() > 1:
            names = self.run.queries.index.to_series()
        entries = () if self.dataset is None else self.dataset.entries
        cameras = {entry.key: entry.camera for entry in entries}
        known = self.run.poses
        return [FoundPose(name, "", known[k], cameras.get(k)) for k, name in names.items() if k in known]


class ExportFormat(Protocol):
    """How a run is written for another program; made without arguments.

    Attributes:
        file_name: File or folder that is written to the run's folder ``export`` where no other is named.
        requires: Of ``dataset``, ``city`` and ``crs``, what the export must hold.

    Offered if the class has it: ``require_room(path)``, which raises where programs would not read what is
    written there; ``optional``, of the same names as ``requires``, what the export holds if it is known.
    """

    file_name: str

    @property
    def requires(self) -> Collection[str]:
        """Returns what it requires; a class attribute will do."""
        ...

    def write(self, export: Export, path: Path) -> None:
        """Writes the run; the folder above ``path`` is there.

        Raises:
            LodbenchError: It holds something that the format cannot.
        """
        ...


@dataclass(frozen=True, slots=True)
class Exported:
    """What was written."""

    path: Path
    count: int
    without_pose: tuple[str, ...]


def wanted_by(form: ExportFormat) -> set[str]:
    """Returns what a format requires, and what it takes where it is known."""
    return {*form.requires, *getattr(form, "optional", ())}


def make_format(name: str) -> ExportFormat:
    """Returns the format of a name.

    Raises:
        ConfigError: There is no such format, or it cannot be made.
    """
    kind = load_plugin("export_formats", name)
    with blaming("export_formats", name, "be made"):
        made: ExportFormat = kind()
        Path(made.file_name), wanted_by(made)
    return made


def export_run(export: Export, form: ExportFormat, out: Path | None = None) -> Exported:
    """Writes a run in a format.

    Args:
        export: The run, and what the format requires.
        form: The format.
        out: File or folder to write; by default in the run's folder ``export``.

    What is there already stays as it is until all is written; other files in a folder stay. Outside of the
    run's folder ``export`` only earlier exports in the format are replaced.

    Raises:
        LodbenchError: The run has no poses, the format cannot hold it, or something else is in its place.
    """
    run = export.run
    if not run.poses:
        raise DatasetError(f"{run.folder} holds no poses.", "queries.csv says why each query failed.")
    path = out or run.folder / "export" / form.file_name
    if hasattr(form, "require_room"):
        form.require_room(path)
    make_folder(path.parent)
    with scratch_folder(path.parent / "export") as folder:
        written = folder / path.resolve().name
        try:
            form.write(export, written)
        except OSError as error:
            if str(error.filename).startswith(str(folder)):
                error.filename = str(path)
            raise
        if not written.exists():
            raise ValueError(f"nothing was written to {path.name}")
        if (run.folder / "export").resolve() not in path.resolve().parents:
            _require_room(written, path)
        _put_in_place(written, path)
    without = run.queries["query"][~run.queries.index.isin(list(run.poses))]
    return Exported(path, len(run.poses), tuple(without))


def _require_room(written: Path, path: Path) -> None:
    """Checks that no file is replaced that is no such export.

    Raises:
        ConfigError: One would be.
    """
    if written.is_dir():
        for each in written.iterdir():
            _require_room(each, path / each.name)
    elif path.is_file() and _head(path) != _head(written) and path.read_bytes() != written.read_bytes():
        raise ConfigError(f"{path} is there already, and is no such export.", "Name another with --out.")


def _head(file: Path) -> bytes:
    """Returns what a file says of its form: its first line, of JSON three, of what is no text four bytes."""
    with file.open("rb") as stream:
        start = stream.read(_HEAD_BYTES)
    if b"\0" in start:
        return start[:4]
    lines = start.splitlines()[:3]
    return b"\n".join(lines if lines[:1] == [b"{"] else lines[:1])


def _put_in_place(written: Path, path: Path) -> None:
    """Gives a file, or each file of a folder, its name."""
    if written.is_dir():
        make_folder(path)
        for each in sorted(written.iterdir()):
            _put_in_place(each, path / each.name)
    elif path.is_dir():
        raise DatasetError(f"{path} is a folder.", "Name a file with --out.")
    else:
        disk().rename(written, path)
