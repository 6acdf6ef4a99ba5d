"""A run's answers in a surveyor's terms: a row per query."""

from __future__ import annotations

from contextlib import suppress
from typing import TYPE_CHECKING

from lodbench.datasets.exchange.survey import SURVEY_COLUMNS, survey_row
from lodbench.errors import LodbenchError
from lodbench.evaluation.queries import own_failure
from lodbench.harness.runs.stored import StoredRun
from lodbench.photos.map_frame import MapFrame
from lodbench.reporting.answers import rounded_down, trust_of
from lodbench.storage import hide_formula

if TYPE_CHECKING:
    import pandas as pd

_COLUMNS = ("photo", "split", *SURVEY_COLUMNS, "probability", "trust", "crs", "failure")


def survey_table(run: StoredRun, crs: str | None) -> pd.DataFrame:
    """Returns a row per query, by ``split/query``: ``photo``, ``split``, ``SURVEY_COLUMNS`` and more.

    Args:
        run: The run.
        crs: Reference system of its poses; None, or one that is none of a map, leaves latitude and longitude
            empty, and headings count from the y axis.

    ``probability`` is that of being within 2 m and 2 degrees, ``trust`` a word for it, ``failure`` why there
    is no pose.
    """
    import pandas as pd

    frame = None
    with suppress(LodbenchError):
        frame = None if crs is None else MapFrame(crs)
    rows = []
    for key, query in run.queries.iterrows():
        found, pose = run.predictions[str(key)], run.poses.get(str(key))
        row = dict.fromkeys(_COLUMNS) | {"photo": query["query"], "split": query["split"]}
        if pose is not None:
            row |= survey_row(pose, None if frame is None else frame.place_of(pose), found.covariance)
        probability = None if found.probability is None else rounded_down(found.probability, 4)
        row |= {"probability": probability, "trust": trust_of(found), "crs": crs}
        rows.append(row | {"failure": own_failure(query["failure"])})
    numbers = dict.fromkeys((*SURVEY_COLUMNS, "probability"), float)
    return pd.DataFrame(rows, index=run.queries.index, columns=list(_COLUMNS)).astype(numbers)


def survey_csv(run: StoredRun, crs: str | None) -> str:
    """Returns ``survey_table`` as CSV; no text is a formula to a spreadsheet."""
    table = survey_table(run, crs)
    for name in ("photo", "split", "failure"):
        table[name] = table[name].map(hide_formula)
    return str(table.to_csv(index=False, lineterminator="\n"))
