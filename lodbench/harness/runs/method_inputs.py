"""What a run's numbers depend on through its method: weights, pictures, and what was prepared from them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from lodbench.citymap import CityMap
from lodbench.datasets.inputs import Input, declared_inputs
from lodbench.datasets.query import Dataset, Entry, Reference
from lodbench.errors import STOPPED, ConfigError, LodbenchError
from lodbench.execution.same_folder import staying_here
from lodbench.execution.single_threaded_blas import single_threaded_blas
from lodbench.harness.tracebacks import keep_traceback, words_of
from lodbench.methods import Method
from lodbench.methods.protocol import SupportsFlights, SupportsPrepare
from lodbench.methods.timed_localize import weight_files
from lodbench.methods.workspace import open_workspace
from lodbench.storage import digest_of
from lodbench.storage.digest import content_digest

# What a workspace's content depends on, of a run's inputs.
_PREPARED_FROM = ("scene", "roofs", "code", "weights", "references", "textured_map")


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
