"""Adjusted networks as files of other programs: GNU Gama XML and a table of coordinates."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator
from xml.etree import ElementTree as ET

import numpy as np

from spheremark.pipelines.geometry import rot_z, yaw_pitch_roll
from spheremark.pipelines.model import Array
from spheremark.pipelines.network import AdjustedNetwork
from spheremark.storage.exports.points import NamedPoint

_NAMESPACE = "http://www.gnu.org/software/gama/gama-local"
_GON = 200.0 / np.pi
_CC = 1e4 * _GON  # [cc/rad] centesimal seconds, in which Gama has sigmas of angles
_MM = 1e3
_EXACT = 2e-5  # [m] control with a smaller sigma is exact
_UNLEVELLED = 0.2  # [rad] sigma of a levelling that was left out
COORDINATE_COLUMNS = (
    "kind", "name", "x_m", "y_m", "z_m", "sigma_x_m", "sigma_y_m", "sigma_z_m",
    "cov_xy_m2", "cov_xz_m2", "cov_yz_m2", "n_observations",
)  # fmt: skip

EVIDENCE_COLUMNS = (
    "mark", "decision", "probability", "decoy", "station", "marker", "finding", "range_m",
    "log_odds", "reason",
)  # fmt: skip


def format_coordinates(result: AdjustedNetwork) -> str:
    """Return stations and marks of a network as CSV.

    Parameters
    ----------
    result : AdjustedNetwork
        The network.

    Returns
    -------
    str
        One row per station and mark, with the columns ``COORDINATE_COLUMNS``.
    """
    network, n = result.network, len(result.network.sightings)
    station, mark = network.sightings[result.used[:n]].T
    counts = [
        *np.bincount(station, minlength=len(network.stations)),
        *np.bincount(mark, minlength=len(network.marks)),
    ]
    covs = np.concatenate([result.station_covariances, result.mark_covariances])
    text = io.StringIO()
    writer = csv.writer(text)
    writer.writerow(COORDINATE_COLUMNS)
    for point, cov, count in zip(network_points(result), covs, counts, strict=True):
        sigmas = np.sqrt(np.diag(cov))
        others = (cov[0, 1], cov[0, 2], cov[1, 2])
        numbers = (*(f"{x:.5f}" for x in point.p_site), *(f"{x:.6f}" for x in sigmas))
        writer.writerow((point.kind, point.name, *numbers, *(f"{x:.4e}" for x in others), count))
    return text.getvalue()


def format_evidence(result: AdjustedNetwork) -> str:
    """Return the evidence on the marks of a network as CSV.

    Parameters
    ----------
    result : AdjustedNetwork
        The network.

    Returns
    -------
    str
        One row per mark and station that is near enough to see it, with the columns
        ``EVIDENCE_COLUMNS``.
    """
    text = io.StringIO()
    writer = csv.writer(text)
    writer.writerow(EVIDENCE_COLUMNS)
    for mark in result.network.evidence:
        of_mark = (mark.mark, mark.decision, f"{mark.probability:.6g}", mark.decoy)
        for one in mark.stations:
            numbers = (f"{one.range:.3f}", f"{one.log_odds:.3f}")
            writer.writerow((*of_mark, one.station, one.marker, one.finding, *numbers, one.reason))
    return text.getvalue()


def network_points(result: AdjustedNetwork) -> list[NamedPoint]:
    """Return the stations of a network and its marks as named points.

    Parameters
    ----------
    result : AdjustedNetwork
        The network.

    Returns
    -------
    list of NamedPoint
        Of the kinds station, control and mark.
    """
    network = result.network
    kinds = ["control" if i in network.controls else "mark" for i in range(len(network.marks))]
    labels = [
        *(("station", name) for name in network.stations),
        *zip(kinds, network.marks, strict=True),
    ]
    places = np.concatenate([result.T_site_station[:, :3, 3], result.p_site]).tolist()
    return [
        NamedPoint(kind=kind, name=name, p_site=p)
        for (kind, name), p in zip(labels, places, strict=True)
    ]


def format_gama(result: AdjustedNetwork, description: str = "") -> str:
    """Return a network's observations as input of GNU Gama's ``gama-local``.

    Parameters
    ----------
    result : AdjustedNetwork
        The network; observations that its tests excluded are not written.
    description : str
        A sentence for the reader of the file.

    Returns
    -------
    str
        XML: points with adjusted coordinates as approximate values, and for each station a set of
        directions (counter-clockwise), zenith angles [gon] and slope distances [m] in the levelled
        frame, with their full covariance [cc, mm].

    Notes
    -----
    Gama has levelled instruments only. The uncertainty of the levelling rotates all centres of a
    station together and is in the covariance of the set, so that Gama solves the same problem. It
    is linearised at the adjusted network: otherwise half a degree of levelling would tilt a free
    network by a millimetre. The orientation of a set is the heading of the station. Distances are
    corrected for the range bias of the network. Control marks are observed coordinates, exact ones
    with the sigma that the adjustment gives them: fixed points are no unknowns in Gama, and its
    graph of unknowns would have one part for each station ("network is not connected"). In a free
    network the marks define the datum (``adj="XYZ"``).
    """
    root = ET.Element("gama-local", xmlns=_NAMESPACE)
    frame = {"axes-xy": "en", "angles": "right-handed"}
    network = ET.SubElement(root, "network", frame)
    text = " ".join(filter(None, (description or "Written by spheremark.", *_reduced(result))))
    ET.SubElement(network, "description").text = text
    parameters = {"sigma-apr": "1", "conf-pr": "0.95", "tol-abs": "1000", "sigma-act": "apriori"}
    ET.SubElement(network, "parameters", parameters)
    observed = ET.SubElement(network, "points-observations")
    _add_points(observed, result)
    for station in range(len(result.network.stations)):
        _add_set(observed, result, station)
    _add_control(observed, result)
    ET.indent(root)
    return '<?xml version="1.0" ?>\n' + ET.tostring(root, encoding="unicode") + "\n"


def _reduced(result: AdjustedNetwork) -> Iterator[str]:
    """Yield what of the network Gama's model has no place for, as sentences."""
    if names := result.network.shared.names:
        sigmas = np.sqrt(np.diag(result.cov_shared))
        known = ", ".join(
            f"{name} = {value:.3g} (sigma {sigma:.2g})"
            for name, value, sigma in zip(names, result.shared, sigmas, strict=True)
        )
        yield (
            f"Reduced: the observations are corrected for what all stations share ({known}), whose "
            "uncertainty is not in this file: standard deviations from it are those of known "
            "corrections and at most as large as spheremark's, and the variance factor has "
            f"the prior of {len(names)} unknown(s) less."
        )
    covs = result.network.cov_control_site
    if not result.network.is_free and (np.diagonal(covs, axis1=1, axis2=2) < _EXACT**2).any():
        yield "Exact control has a sigma of 0.01 mm, as in spheremark: the network stays connected."
    if result.network.is_free:
        yield (
            "Datum: all marks together here, the first station in spheremark; coordinates agree, "
            "their standard deviations refer to that datum."
        )


def _used_controls(result: AdjustedNetwork) -> list[tuple[int, int]]:
    """Return row and mark of each control mark that was used."""
    network = result.network
    used = result.used[len(network.sightings) + len(network.stations) :]
    return [(row, int(mark)) for row, mark in enumerate(network.controls) if used[row]]


def _add_points(parent: ET.Element, result: AdjustedNetwork) -> None:
    """Add marks and stations with approximate coordinates."""
    network = result.network
    status = {"adj": "XYZ" if network.is_free else "xyz"}
    for name, p in zip(network.marks, result.p_site, strict=True):
        _add_point(parent, name, p, status)
    for name, T in zip(network.stations, result.T_site_station, strict=True):
        _add_point(parent, name, T[:3, 3], {"adj": "xyz"})


def _add_point(parent: ET.Element, name: str, p: Array, status: dict[str, str]) -> None:
    """Add a point."""
    x, y, z = (f"{value:.6f}" for value in p)
    ET.SubElement(parent, "point", {"id": name, "x": x, "y": y, "z": z, **status})


def _add_set(parent: ET.Element, result: AdjustedNetwork, station: int) -> None:
    """Add the observations of a station."""
    network, n = result.network, len(result.network.sightings)
    rows = np.flatnonzero((network.sightings[:, 0] == station) & result.used[:n])
    level = _level(result.T_site_station[station, :3, :3])
    R = level @ network.R_station_base[station]
    heights = network.heights_base[rows]  # an error that all centres share stays in the file
    p = (result.p_base[rows] + result.heights[station] * heights) @ R.T
    values, J = _polar(p)
    lifts = np.einsum("nij,jk,nk->ni", J, R, heights)
    cov = np.einsum("na,mb->namb", lifts, lifts)
    cov[np.arange(len(rows)), :, np.arange(len(rows)), :] += (
        J @ R @ network.cov_p_base[rows] @ R.T @ np.swapaxes(J, 1, 2)
    )
    cov_up = R @ network.cov_up_base[station] @ R.T
    if not result.used[n + station]:
        cov_up = _UNLEVELLED**2 * np.diag([1.0, 1.0, 0.0])
    leaned = np.stack([-p[:, 2:] * [1, 0, 0], -p[:, 2:] * [0, 1, 0]], axis=2)
    leaned[:, 2, 0], leaned[:, 2, 1] = p[:, 0], p[:, 1]
    leaned = J @ leaned  # derivative by the horizontal coordinates of the up direction
    values = values + leaned @ level[:2, 2]
    cov += np.einsum("iak,kl,jbl->iajb", leaned, cov_up[:2, :2], leaned)
    group = ET.SubElement(parent, "obs", {"from": network.stations[station]})
    for (azimuth, zenith, distance), row in zip(values, rows, strict=True):
        to = network.marks[network.sightings[row, 1]]
        gon = azimuth * _GON % 400.0
        ET.SubElement(group, "direction", {"to": to, "val": f"{gon:.9f}"})
        ET.SubElement(group, "z-angle", {"to": to, "val": f"{zenith * _GON:.9f}"})
        ET.SubElement(group, "s-distance", {"to": to, "val": f"{distance:.7f}"})
    scale = np.tile([_CC, _CC, _MM], len(rows))
    _add_covariance(group, cov.reshape(3 * len(rows), -1) * np.outer(scale, scale))


def _level(R_site_station: Array) -> Array:
    """Return the levelling rotation of an adjusted station, without its heading."""
    yaw = yaw_pitch_roll(R_site_station)[0]
    return np.asarray(rot_z(-yaw) @ R_site_station)


def _polar(p: Array) -> tuple[Array, Array]:
    """Return azimuth, zenith angle and distance of points, (k, 3), and their derivative."""
    x, y, z = p.T
    flat, r = np.hypot(x, y), np.linalg.norm(p, axis=1)
    o = np.zeros_like(x)
    J = np.stack(
        [
            np.stack([-y / flat**2, x / flat**2, o], axis=1),
            np.stack([x * z / flat, y * z / flat, -flat], axis=1) / r[:, None] ** 2,
            p / r[:, None],
        ],
        axis=1,
    )
    return np.stack([np.arctan2(y, x), np.arctan2(flat, z), r], axis=1), J


def _add_control(parent: ET.Element, result: AdjustedNetwork) -> None:
    """Add control marks as observed coordinates."""
    network, loose = result.network, _used_controls(result)
    if not loose:
        return
    group = ET.SubElement(parent, "coordinates")
    cov = np.zeros((len(loose), 3, len(loose), 3))
    for k, (row, mark) in enumerate(loose):
        x, y, z = (f"{value:.6f}" for value in network.p_control_site[row])
        ET.SubElement(group, "point", {"id": network.marks[mark], "x": x, "y": y, "z": z})
        cov[k, :, k] = network.cov_control_site[row] * _MM**2
    _add_covariance(group, cov.reshape(3 * len(loose), -1))


def _add_covariance(parent: ET.Element, cov: Array) -> None:
    """Add the upper triangle of a covariance."""
    n = len(cov)
    rows = [" ".join(f"{value:.9e}" for value in cov[i, i:]) for i in range(n)]
    matrix = ET.SubElement(parent, "cov-mat", {"dim": str(n), "band": str(n - 1)})
    matrix.text = "\n" + "\n".join(rows) + "\n"
