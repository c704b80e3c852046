"""The one solution of a survey that pages, plots, exports and responses show."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime

from spheremark.storage.catalogue.catalogue import Catalogue

_CHOSEN = "SELECT * FROM chosen_solutions WHERE survey_id = $id"


@dataclass(frozen=True, slots=True, kw_only=True)
class Solution:
    """The chosen solution: a row of ``chosen_solutions``, whose comments define the columns."""

    survey_id: str
    survey: str
    solution: str
    adjustment_id: str | None
    fit_method: str
    resection_method: str | None
    finished_at: datetime

    @property
    def is_free(self) -> bool:
        """Whether its frame is that of the first station."""
        return self.solution == "free network"


def chosen_solution(catalogue: Catalogue, survey: str) -> Solution | None:
    """Return the solution that a survey shows; the view of this name decides.

    Parameters
    ----------
    catalogue : Catalogue
        The database.
    survey : str
        Id or name of the survey.

    Returns
    -------
    Solution or None
        None where no station has coordinates.
    """
    rows = catalogue.rows(_CHOSEN, {"id": catalogue.id_of_survey(survey)})
    return Solution(**rows[0]) if rows else None
