"""Networks as files of other programs, read back without the code that wrote them."""

import csv
import io
from dataclasses import replace
from xml.etree import ElementTree as ET

import numpy as np
import pytest
from scipy.optimize import least_squares

from spheremark.pipelines.config import ResectionConfig
from spheremark.pipelines.network import adjust_network, assemble
from spheremark.storage.exports.network import format_coordinates, format_gama
from tests.synthetic import field, pose, sightings

CONFIG = ResectionConfig(sigma_common=0.0, sigma_range=0.0, sigma_range_scale=0.0)
GAMA = {"g": "http://www.gnu.org/software/gama/gama-local"}
HUNDREDTH = 1e-5  # [m]


def adjusted(is_free, *, exact=False, n=4):
    """A small network with noise as claimed."""
    rng = np.random.default_rng(5)
    marks = field(rng, 8, middle=(250.0, 40.0, 3.0))
    cov = np.zeros((8, 3, 3)) if exact else np.tile(np.diag([2e-3, 2e-3, 3e-3]) ** 2, (8, 1, 1))
    noise = 0.0 if exact else rng.normal(0, 2e-3, (8, 3))
    scans = []
    for i in range(n):
        lean = rng.uniform(-0.1, 0.1, 2)
        place = marks.p_site.mean(axis=0) + rng.uniform([-4, -4, -0.4], [4, 4, 0])
        fits = sightings(
            marks, pose(place, rng.uniform(-3, 3), lean), sigma_level=3e-3,
            lean=tuple(lean + rng.normal(0, 3e-3, 2)), noise=rng.normal(0, 4e-3, (8, 3)),
        )  # fmt: skip
        shared = tuple(replace(fit, sigma_height_shared=1.5e-3) for fit in fits.fits)
        scans.append((f"stop{i + 1}", replace(fits, fits=shared)))
    given = replace(marks, p_site=marks.p_site + noise, cov_p_site=cov)
    return adjust_network(assemble(scans, None if is_free else given, CONFIG), CONFIG)


def covariance(element):
    """The matrix of a cov-mat, from the rows of its upper triangle."""
    (matrix,) = element.findall("g:cov-mat", GAMA)
    n = int(matrix.get("dim"))
    assert int(matrix.get("band")) == n - 1
    upper = np.zeros((n, n))
    upper[np.triu_indices(n)] = [float(word) for word in matrix.text.split()]
    return upper + np.triu(upper, 1).T


class GamaNetwork:
    """What gama-local would read: levelled sets of directions, zenith angles and distances."""

    def __init__(self, text):
        root = ET.fromstring(text)
        (self.network,) = root.findall("g:network", GAMA)
        (body,) = self.network.findall("g:points-observations", GAMA)
        points = body.findall("g:point", GAMA)
        self.names = [point.get("id") for point in points]
        self.start = np.array([[float(point.get(k)) for k in "xyz"] for point in points])
        self.is_fixed = np.array([point.get("fix") == "xyz" for point in points])
        self.is_datum = np.array([point.get("adj") == "XYZ" for point in points])
        self.sets = [self.read_set(one) for one in body.findall("g:obs", GAMA)]
        self.given = [self.read_given(one) for one in body.findall("g:coordinates", GAMA)]

    def place(self, name):
        return self.names.index(name)

    def read_set(self, one):
        kinds = [child.tag.rpartition("}")[2] for child in one if "val" in child.attrib]
        observed = [child for child in one if "val" in child.attrib]
        values = np.array([float(child.get("val")) for child in observed])
        to = [self.place(child.get("to")) for child in observed]
        return self.place(one.get("from")), kinds, np.array(to), values, covariance(one)

    def read_given(self, one):
        points = one.findall("g:point", GAMA)
        values = np.array([[float(point.get(k)) for k in "xyz"] for point in points])
        return [self.place(point.get("id")) for point in points], values, covariance(one)

    def n_parts(self):
        """Parts of the graph of unknowns: those of one observation are joined, fixed ones are none.

        Gama calls a network with more than one of them not connected.
        """
        part = {
            name: name for name, fixed in zip(self.names, self.is_fixed, strict=True) if not fixed
        }
        part |= {i: i for i in range(len(self.sets))}  # orientations

        def root(one):
            while part[one] != one:
                one = part[one]
            return one

        for i, (here, kinds, to, _, _) in enumerate(self.sets):
            for kind, mark in zip(kinds, to, strict=True):
                own = [self.names[here], self.names[mark], *([i] if kind == "direction" else [])]
                roots = [root(one) for one in own if one in part]
                for other in roots[1:]:
                    part[root(other)] = root(roots[0])
        return len({root(one) for one in part})

    def residuals(self, x):
        """Whitened residuals in Gama's units: gon to cc, metres to millimetres."""
        p = self.start.copy()
        p[~self.is_fixed] = x[: 3 * np.sum(~self.is_fixed)].reshape(-1, 3)
        orientations = x[3 * np.sum(~self.is_fixed) :]
        out = []
        for (here, kinds, to, values, cov), turn in zip(self.sets, orientations, strict=True):
            v = p[to] - p[here]
            flat, gon = np.hypot(v[:, 0], v[:, 1]), 200 / np.pi
            bearing = np.arctan2(v[:, 1], v[:, 0]) * gon - turn  # counter-clockwise
            model = {"direction": bearing, "z-angle": np.arctan2(flat, v[:, 2]) * gon}
            model["s-distance"] = np.linalg.norm(v, axis=1)
            computed = np.array([model[kind][i] for i, kind in enumerate(kinds)])
            off = values - computed
            is_direction = np.array([kind == "direction" for kind in kinds])
            off[is_direction] = (off[is_direction] + 200) % 400 - 200
            off *= np.where([kind == "s-distance" for kind in kinds], 1e3, 1e4)
            out.append(np.linalg.solve(np.linalg.cholesky(cov), off))
        for places, values, cov in self.given:
            off = 1e3 * (values - p[places]).ravel()
            out.append(np.linalg.solve(np.linalg.cholesky(cov), off))
        if self.is_datum.any():
            centre = self.start[self.is_datum] - self.start[self.is_datum].mean(axis=0)
            shift = (p - self.start)[self.is_datum]
            out.append(1e5 * shift.mean(axis=0))
            out.append([1e4 * np.mean(centre[:, 0] * shift[:, 1] - centre[:, 1] * shift[:, 0])])
        return np.concatenate(out)

    def solve(self):
        """Coordinates by name, from a start that is off."""
        rng = np.random.default_rng(1)
        x0 = self.start[~self.is_fixed].ravel()
        x0 = x0 + rng.normal(0, 0.005, len(x0))
        turns = []
        for here, kinds, to, values, _ in self.sets:
            i = kinds.index("direction")
            v = self.start[to[i]] - self.start[here]
            turns.append(np.arctan2(v[1], v[0]) * 200 / np.pi - values[i])
        found = least_squares(self.residuals, [*x0, *turns], xtol=1e-13, ftol=1e-13, x_scale="jac")
        p = self.start.copy()
        p[~self.is_fixed] = found.x[: 3 * np.sum(~self.is_fixed)].reshape(-1, 3)
        return dict(zip(self.names, p, strict=True)), 2 * found.cost


@pytest.mark.parametrize(("is_free", "exact"), [(True, False), (False, False), (False, True)])
def test_a_dense_solution_of_the_exported_observations_agrees(is_free, exact):
    result = adjusted(is_free, exact=exact)
    assert result.used.all()
    read = GamaNetwork(format_gama(result))
    p, vtpv = read.solve()
    for name, place in zip(result.network.marks, result.p_site, strict=True):
        np.testing.assert_allclose(p[name], place, rtol=0, atol=HUNDREDTH)
    for name, T in zip(result.network.stations, result.T_site_station, strict=True):
        np.testing.assert_allclose(p[name], T[:3, 3], rtol=0, atol=HUNDREDTH)
    assert vtpv == pytest.approx(result.vtpv, rel=1e-3)
    assert read.is_datum.any() == is_free
    assert read.n_parts() == 1


@pytest.mark.parametrize("exact", [False, True])
def test_standard_deviations_of_the_exported_observations_are_ours_but_for_what_is_reduced(exact):
    result = adjusted(False, exact=exact)
    read = GamaNetwork(format_gama(result))
    x0 = np.concatenate([read.start[~read.is_fixed].ravel(), np.zeros(len(read.sets))])
    places, _ = read.solve()
    p = np.array([places[name] for name in read.names])
    x0[: 3 * np.sum(~read.is_fixed)] = p[~read.is_fixed].ravel()
    J = np.empty((len(read.residuals(x0)), len(x0)))
    for k, step in enumerate(np.where(np.arange(len(x0)) < 3 * np.sum(~read.is_fixed), 1e-5, 1e-4)):
        ahead, behind = x0.copy(), x0.copy()
        ahead[k] += step
        behind[k] -= step
        J[:, k] = (read.residuals(ahead) - read.residuals(behind)) / (2 * step)
    sigmas = np.sqrt(np.diag(np.linalg.inv(J.T @ J)))[: 3 * np.sum(~read.is_fixed)].reshape(-1, 3)
    names = [name for name, fixed in zip(read.names, read.is_fixed, strict=True) if not fixed]
    ours = dict(zip(result.network.marks, result.mark_covariances, strict=True))
    ours |= dict(zip(result.network.stations, result.station_covariances, strict=True))
    expected = np.array([np.sqrt(np.diag(ours[name])) for name in names])
    np.testing.assert_allclose(sigmas[:, :2], expected[:, :2], rtol=5e-3)
    np.testing.assert_allclose(sigmas[:8, 2], expected[:8, 2], rtol=5e-3)
    (shared,) = np.sqrt(np.diag(result.cov_shared))  # the height of all stations over their marks
    np.testing.assert_allclose(np.hypot(sigmas[8:, 2], shared), expected[8:, 2], rtol=5e-3)


def test_the_export_says_what_it_leaves_out():
    rng = np.random.default_rng(5)
    marks = field(rng, 8, middle=(250.0, 40.0, 3.0))
    scans = [
        (f"stop{i}", sightings(marks, pose(marks.p_site.mean(axis=0) + np.array([i, 0, 0]), i)))
        for i in range(4)
    ]
    config = ResectionConfig(sigma_range=0.003)
    result = adjust_network(assemble(scans, marks, config), config)
    assert result.network.shared.names
    text = GamaNetwork(format_gama(result)).network.find("g:description", GAMA).text
    assert "Reduced: the observations are corrected" in text
    assert all(name in text for name in result.network.shared.names)


def test_fixed_control_would_not_be_connected_in_gama_and_is_observed_instead():
    text = format_gama(adjusted(False, exact=True))
    assert "the network stays connected" in text
    fixed = GamaNetwork(text)
    fixed.is_fixed = np.array([not name.startswith("stop") for name in fixed.names])
    assert fixed.is_fixed.sum() == 8
    assert fixed.n_parts() == len(fixed.sets) == 4


def test_the_export_states_its_axes_and_angles():
    read = GamaNetwork(format_gama(adjusted(True), "Two <stations> & more"))
    assert read.network.get("axes-xy") == "en"
    assert read.network.get("angles") == "right-handed"
    (text,) = read.network.findall("g:description", GAMA)
    assert text.text.startswith("Two <stations> & more ")
    assert "Datum: all marks together" in text.text


def test_what_the_tests_left_out_is_not_exported():
    result = adjusted(True)
    spoiled = result.used.copy()
    spoiled[3] = False
    read = GamaNetwork(format_gama(replace(result, used=spoiled)))
    n = len(result.network.sightings)
    assert sum(len(values) for _, _, _, values, _ in read.sets) == 3 * (n - 1)


def test_coordinates_come_with_sigmas():
    result = adjusted(False)
    rows = list(csv.DictReader(io.StringIO(format_coordinates(result))))
    assert [row["kind"] for row in rows] == ["station"] * 4 + ["control"] * 8
    last = rows[-1]
    assert last["name"] == "H"
    assert float(last["x_m"]) == pytest.approx(result.p_site[-1, 0], abs=1e-5)
    assert float(last["sigma_z_m"]) == pytest.approx(
        np.sqrt(result.mark_covariances[-1, 2, 2]), abs=1e-6
    )
    assert last["n_observations"] == "4"
