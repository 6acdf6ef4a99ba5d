"""Rules of what writes a run for other programs."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from lodbench.evaluation.evaluate import evaluate
from lodbench.evaluation.predictions import Prediction
from lodbench.harness.conformance.trial import Rules, Tried, require
from lodbench.harness.export.export import CITY, CRS, DATASET, Export, ExportFormat, export_run, wanted_by
from lodbench.harness.runs.stored import StoredRun

# Where the blocks could stand.
_CRS = "EPSG:25832"


def export_rules(tried: Tried) -> Rules:
    """Returns the rules of an export format."""

    def declared() -> str:
        form: ExportFormat = tried.part()
        unknown = sorted(wanted_by(form) - {DATASET, CITY, CRS})
        require(not unknown, f"requires {', '.join(unknown)}", f"Of {DATASET}, {CITY} and {CRS}.")
        require(Path(form.file_name).name == form.file_name, f"file_name {form.file_name!r} is no name")
        return f"{form.file_name}; requires {', '.join(form.requires) or 'nothing'}"

    def written() -> str:
        form, run = tried.part(), _run_of(tried)
        export = Export(
            run,
            tried.dataset if DATASET in form.requires else None,
            tried.scene if CITY in form.requires else None,
            _CRS if CRS in wanted_by(form) else None,
        )
        before = run.queries.copy(deep=True)
        contents = []
        for name in ("first", "second"):
            path = tried.folder / name / form.file_name
            done = export_run(export, form, path)
            require(path.exists(), f"nothing was written to {path.name}", "Write to the path that is given.")
            contents.append(dict(_contents(path)))
        require(run.queries.equals(before), "the queries were written to", "Work on a copy.")
        require(contents[0] == contents[1], "the same run, other bytes", "Leave out times and random ids.")
        return f"{done.count} poses of {len(run.queries)} queries, the same bytes again"

    return [("declared", declared), ("written", written)]


def _run_of(tried: Tried) -> StoredRun:
    """Returns a run that found all photos but the last."""
    dataset, entries = tried.dataset, tried.entries
    found = {entry.key: Prediction(dataset.truth[entry.key]) for entry in entries[:-1]}
    predictions = {**found, entries[-1].key: Prediction(None, "no mask")}
    queries = evaluate(entries, predictions, dataset.truth, {entry.key: entry.prior for entry in entries})
    poses = {key: prediction.pose for key, prediction in found.items() if prediction.pose is not None}
    summary = {"method": {"name": "trial", "variant": ""}, "dataset": {"name": dataset.name}}
    return StoredRun(tried.folder / "run", summary, {}, queries, poses, (), {})


def _contents(path: Path) -> Iterator[tuple[str, bytes]]:
    for file in sorted(path.rglob("*")) if path.is_dir() else [path]:
        if file.is_file():
            yield str(file.relative_to(path)), file.read_bytes()
