"""The published datasets by name."""

from __future__ import annotations

from lodbench.datasets.published import swiss_epfl, swiss_epflv2, uavd4l_lod, uavd4l_lodv2
from lodbench.datasets.published.spec import PublishedSpec
from lodbench.errors import ConfigError, nearest_names

SPECS: dict[str, PublishedSpec] = {
    spec.id: spec for spec in (uavd4l_lod.SPEC, uavd4l_lodv2.SPEC, swiss_epfl.SPEC, swiss_epflv2.SPEC)
}


def spec_of(name: str) -> PublishedSpec:
    """Returns the spec of a dataset.

    Raises:
        ConfigError: There is none of that name.
    """
    if name not in SPECS:
        raise ConfigError(f"There is no published dataset {name!r}.", nearest_names(name, SPECS))
    return SPECS[name]
