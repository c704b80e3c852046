"""Captions of the figures that have an address."""

from __future__ import annotations

from collections.abc import Mapping

_BINS = (
    "Lines are medians of bins, bands hold 95 % of a bin, dots are the worst {n} of each. Click a"
    " median to filter to its bin, a dot to open its marker."
)
CAPTIONS: Mapping[str, str] = {
    "distance": _BINS,
    "count": _BINS,
    "incidence": _BINS + " Incidence is the mean angle between the used beams and the sphere.",
    "angle": (
        "The station from two of its marks, by their included angle; medians, bands and worst as"
        " above. Circles of two marks touch near 0 and 180 deg, hence the limits of the study; 3-D"
        " centres lose nothing towards 180 deg."
    ),
    "distribution": "All centres of each method: the better one is farther to the left.",
    "surveys": "Median and band of 95 % of each survey; click one for its own dashboard.",
    "solution": (
        "Ellipses are those of 95 % probability, horizontal. Where truth is known, the line from a"
        " station ends at its true position, with the same scale."
    ),
    "heights": (
        "Bars are the 95 % interval of each height. Where truth is known, dots are the height"
        " error."
    ),
    "map": (
        "Click a station or its ellipse to open it. The thin line ends at the true place; the thick"
        " bar is the error of height, upwards if too high (without truth twice its sigma)."
    ),
}
