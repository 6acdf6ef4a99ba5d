"""``method=prior_only``: answers the prior itself, the floor any method must rise above."""

from __future__ import annotations

from dataclasses import dataclass

from lodbench.citymap import CityMap
from lodbench.datasets.query import Query
from lodbench.methods import Estimate, Input, Streams


@dataclass(frozen=True, slots=True)
class PriorOnlyParams:
    """Settings of ``method=prior_only``: none."""

    name: str = "prior_only"


class PriorOnly:
    """Returns every query's prior, unscored."""

    params_type = PriorOnlyParams
    name = "prior_only"
    requires: frozenset[Input] = frozenset()

    def __init__(self, params: PriorOnlyParams) -> None:
        self.params = params

    def localize(self, query: Query, city_map: CityMap, streams: Streams) -> Estimate:
        """Returns the prior."""
        return Estimate(query.prior, score=float("nan"))
