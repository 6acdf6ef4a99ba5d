"""What a dataset makes only for a method that asks for it: a textured map, posed pictures of the place."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace

from lodbench.datasets.inputs import Input
from lodbench.datasets.query import Dataset
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
    return dataset
