"""The published datasets by name."""

from __future__ import annotations

from lodbench.datasets.published import (
    anyvisloc,
    egeniouss,
    ortholoc,
    semcitylocked,
    swiss_epfl,
    swiss_epflv2,
    tokyo_lodv3,
    uavd4l,
    uavd4l_lod,
    uavd4l_lodv2,
)
from lodbench.datasets.published.spec import PublishedSpec
from lodbench.errors import ConfigError, nearest_names

SPECS: dict[str, PublishedSpec] = {
    module.SPEC.id: module.SPEC
    for module in (
        uavd4l_lod,
        uavd4l_lodv2,
        swiss_epfl,
        swiss_epflv2,
        tokyo_lodv3,
        uavd4l,
        egeniouss,
        ortholoc,
        anyvisloc,
        semcitylocked,
    )
}


def spec_of(name: str) -> PublishedSpec:
    """Returns the spec of a dataset.

    Raises:
        ConfigError: There is none of that name.
    """
    if name not in SPECS:
        raise ConfigError(f"There is no published dataset {name!r}.", nearest_names(name, SPECS))
    return SPECS[name]
