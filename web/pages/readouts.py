"""Key numbers of a survey."""

from __future__ import annotations

import math

import numpy as np

from spheremark.pipelines.accuracy import ErrorSummary, summarise
from spheremark.web import theme
from spheremark.web.columns import MM, Columns, by_method, floats, has_errors, on_marks, rms, select
from spheremark.web.pages.base import Readout
from spheremark.web.templating import number


def headline(fits: Columns, fixes: Columns, tolerance_m: float) -> tuple[Readout, ...]:
    """Return the quality of centres and stations by method, and the predicted sigma."""
    readouts = []
    for method, rows in by_method(fits):
        real = on_marks(rows)
        n_others = int(np.count_nonzero(~real))
        one = _quality("Centres", method, select(rows, real), tolerance_m)
        readouts.append(
            one._replace(note=f"{one.note}; {n_others} on no mark") if n_others else one
        )
    for method, rows in by_method(fixes):
        readouts.append(_quality("Stations", method, rows, tolerance_m))
    ours = [rows for method, rows in by_method(fits) if method == "along_beam"]
    return (*readouts, *(_predicted(rows) for rows in ours if has_errors(rows)))


def _quality(what: str, method: str, rows: Columns, tolerance_m: float) -> Readout:
    """Return the error of one method against truth; without truth its predicted sigma."""
    is_error = has_errors(rows)
    summary = summarise(floats(rows, "error_3d_m" if is_error else "sigma_3d_m"), tolerance_m)
    label, value = f"{what}, {theme.method_style(method).label}", number(summary.rms * MM, 1)
    unit = "mm RMS error" if is_error else "mm predicted sigma"
    return Readout(label, value, unit, _share(summary, tolerance_m, is_error=is_error), method)


def _share(summary: ErrorSummary, tolerance_m: float, *, is_error: bool) -> str:
    """Return the note on the share within the tolerance and the largest."""
    if not summary.n:
        return "none yet"
    within = round(summary.share_within * summary.n)
    what = "within" if is_error else "with a sigma within"
    return (
        f"{within} of {summary.n} {what} {tolerance_m * MM:g} mm, "
        f"largest {summary.largest * MM:.1f} mm"
    )


def _predicted(rows: Columns) -> Readout:
    """Return the predicted sigma and its ratio to the error."""
    error, sigma = floats(rows, "error_3d_m"), floats(rows, "sigma_3d_m")
    known = np.isfinite(error)
    sigma_rms = rms(sigma[known])
    ratio = rms(error[known]) / sigma_rms if sigma_rms else math.nan
    note = f"error over sigma {ratio:.2f}; expected 1"
    return Readout(
        "Centres, predicted by us", number(sigma_rms * MM, 1), "mm sigma", note, "along_beam"
    )
