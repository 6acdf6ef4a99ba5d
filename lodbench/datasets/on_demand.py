"""What a dataset makes only for a method that asks for it: a textured map, posed pictures, instances."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace
from pathlib import Path

from lodbench.datasets.inputs import Input
from lodbench.datasets.query import Dataset, Entry
from lodbench.datasets.references import read_references


def with_inputs(dataset: Dataset, requires: Collection[str]) -> Dataset:
    """Returns a dataset with what a method requires of it made, where the dataset makes it on demand.

    Raises:
        LodbenchError: It cannot be made.
    """
    if Input.TEXTURED_MAP in requires and Input.TEXTURED_MAP in dataset.on_demand:
        dataset = replace(dataset, textured_map=dataset.on_demand[Input.TEXTURED_MAP]())
    if Input.REFERENCES in requires and Input.REFERENCES in dataset.on_demand:
        dataset = replace(dataset, references=read_references(dataset.on_demand[Input.REFERENCES]()))
    if Input.INSTANCES in requires and Input.INSTANCES in dataset.on_demand:
        folder = dataset.on_demand[Input.INSTANCES]()
        dataset = replace(dataset, entries=tuple(_labelled(entry, folder) for entry in dataset.entries))
    return dataset


def _labelled(entry: Entry, folder: Path) -> Entry:
    """Returns an entry with its labels of a folder of ``SPLIT/STEM.png``, if they are there."""
    file = folder / entry.split / f"{Path(entry.name).stem}.png"
    return replace(entry, instances=file) if file.is_file() else entry
