"""Bounds of arrangements: the best of divided marks, then branch and bound to whole ones."""

from __future__ import annotations

from collections.abc import Callable
from heapq import heappop, heappush
from typing import NamedTuple

import numpy as np

from spheremark.pipelines.compilation import REASSOCIATED, compiled, compiled_with
from spheremark.pipelines.model import Array, Column, Index
from spheremark.pipelines.placement.packing import N_PACKED, squares_of, variance_of
from spheremark.pipelines.progress import checkpoint
from spheremark.pipelines.threads import by_turns

EXCESS = 0.05
"""Of a plan over the bound at which branching may end."""

_STEPS = 61  # of a relaxation in one go; the last one is full
_FULL_EVERY = 6  # steps with all places; only these bound
_GOES = 10  # of the relaxation of all places
_CLOSED = 1.004  # objective over bound of a relaxation that is solved
_HOPELESS = 12  # steps after which one that cannot reach its limit is given up
_PACE = 6.0  # exponent of the first steps of the weights of stops
_FAINT = 1e-4  # share of a mark that is none
_ENTERS = 0.05  # share of the marks of a region with which a place enters
_ROUNDS = 4  # in which the scale of shares settles well enough: the bound holds for any
_ROUNDING = 1e-5  # of single precision, in which information is kept
_AT_ONCE = 16  # nodes that are opened before the next are chosen
_EFFORT = 2.5e8  # places in all steps of all nodes; some 45 s

Report = Callable[[float, float], None]
"""Takes the share of the effort, and the bound so far [m]."""


class Places(NamedTuple):
    """Where marks may stand, and what each adds to each stop."""

    rows: Column  # (c, s * 28) information of a mark at each place, packed, single precision
    start: Array  # (s, 28) of stops without marks
    groups: Index  # (c,) places too near to each other for two marks
    p_site: Array  # (c, 3) the places [m]
    sigma_height: float  # of what all centres are too high together [m]
    is_mean: bool = False  # whether the mean sigma over the stops counts, or the largest

    def sigma(self, bound: float) -> float:
        """Return the sigma of a bound of variances, or of mean sigmas [m]."""
        bound = max((1.0 - _ROUNDING) * bound, 0.0)
        return bound if self.is_mean else float(np.sqrt(bound + self.sigma_height**2))

    def limit(self, sigma: float) -> float:
        """Return the bound of a sigma."""
        bound = sigma if self.is_mean else max(sigma**2 - self.sigma_height**2, 0.0)
        return float(bound / (1.0 - _ROUNDING))

    def value(self, chosen: Index) -> float:
        """Return the sigma of marks that do not hide each other [m]."""
        normal = self.start + self.rows[chosen].sum(axis=0, dtype=np.float64).reshape(-1, N_PACKED)
        variances = np.array([variance_of(one) for one in normal])
        sigmas = np.sqrt(variances + self.sigma_height**2)
        return float(sigmas.mean() if self.is_mean else sigmas.max())


class Relaxation(NamedTuple):
    """The best arrangement if marks could be divided among places."""

    bound: float  # sigma that no arrangement of whole marks goes below [m]
    shares: Array  # (c,) of a mark at each place
    weights: Array  # (s,) of the stops in the bound


class Branched(NamedTuple):
    """What branch and bound found."""

    bound: float  # sigma that no arrangement goes below [m]
    chosen: Index  # the places of the best arrangement that came along; none is empty
    value: float  # its sigma [m]


class Cells(NamedTuple):
    """A tree of regions of places."""

    order: Index  # (c,) places, so that each region is a run of them
    first: Index  # (n,) begin of each region's run, and behind its end
    last: Index
    left: Index  # (n,) its two parts; 0 for a single place
    right: Index


class Relaxed(NamedTuple):
    """The arrays of one relaxation, which its solution changes."""

    places: Index  # (m,) places, region by region
    begins: Index  # (r + 1,) first of each region among these, and the end
    counts: Index  # (r,) marks in each region
    shares: Array  # (m,) of a mark at each place
    scores: Array  # (m,) worth of each place in the bound
    weights: Array  # (s,) of the stops
    sums: Array  # (r, n + 1) largest sums of 0, 1, 2 and more scores in each region


class Node(NamedTuple):
    """So many marks in each of some regions, and the relaxation around it."""

    cells: tuple[int, ...]
    counts: tuple[int, ...]
    weights: Array  # (s,) of the stops
    places: Index  # with shares
    shares: Array


def relax(given: Places, n_marks: int, report: Report = lambda _share, _bound: None) -> Relaxation:
    """Bound the largest 3-D sigma over the stops, or its mean, over all arrangements.

    Notes
    -----
    The least largest variance over shares of marks, of which no group has more than one, is a
    convex problem. Multiplicative steps on shares and on weights of the stops (Fedorov and Hackl,
    1997; Arora et al., 2012) approach it; the bound needs no convergence. For weights ``w``, and
    with ``Y`` the position's columns of any inverse, ``sum w (2 trace(Y_p) - trace(Y' N Y))`` is
    below the weighted variance of every arrangement and linear in its information, so that the
    arrangement with the largest sum of scores, one in each group, bounds them all. A sigma is
    convex in the information too, so that tangents bound its mean.
    """
    c, n_stops = len(given.p_site), len(given.start)
    state = Relaxed(
        places=np.arange(c),
        begins=np.array([0, c]),
        counts=np.array([n_marks]),
        shares=np.full(c, n_marks / c),
        scores=np.zeros(c),
        weights=np.ones(n_stops),
        sums=np.zeros((1, n_marks + 1)),
    )
    bound = 0.0
    for go in range(_GOES):
        checkpoint()
        found, upper, *_ = _improved(given, state, np.inf)
        bound = max(bound, found)
        report((go + 1) / _GOES, given.sigma(bound))
        if upper <= _CLOSED * bound:
            break
    return Relaxation(given.sigma(bound), state.shares, state.weights)


def branch(
    given: Places,
    n_marks: int,
    around: Relaxation,
    reached: float,
    report: Report = lambda _share, _bound: None,
) -> Branched:
    """Raise a bound until a plan exceeds it by ``EXCESS`` at most, or the effort is spent.

    ``reached`` is the sigma of the plan [m].

    Notes
    -----
    Branch and bound over the numbers of marks in regions of places (Land and Doig, 1960): the node
    with the least bound is opened first; of its regions the one whose shares are widest apart is
    halved, and its marks are divided between the halves in every way. A bound by the weights and
    inverses of the node above costs a few sums; only then a relaxation of the node's own is solved.
    The effort counts places, so that the answer does not depend on the machine.
    """
    tree = _Tree(given)
    keep = np.flatnonzero(around.shares > 0.0)
    root = Node((0,), (n_marks,), around.weights, keep, around.shares[keep])
    heap = [(given.limit(around.bound), 0, root)]
    best, chosen = reached, np.zeros(0, np.intp)
    spent, serial, least = 0.0, 1, np.inf
    while heap and spent < _EFFORT and heap[0][0] < given.limit(best / (1.0 + EXCESS)):
        checkpoint()
        report(spent / _EFFORT, given.sigma(min(heap[0][0], least)))
        limit = given.limit(best / (1.0 + EXCESS))
        some = [heappop(heap) for _ in range(min(_AT_ONCE, len(heap)))]
        for opened in tree.opened(some, limit):
            spent += opened.effort
            if opened.value < best:
                best, chosen = opened.value, opened.chosen
            if not opened.children:
                least = min(least, opened.bound)
            for bound, node in opened.children:
                heappush(heap, (bound, serial, node))
                serial += 1
    bound = min(heap[0][0] if heap else np.inf, least)
    return Branched(min(given.sigma(bound), best), chosen, best)


def _halved(p_site: Array) -> Cells:
    """Halve places again and again, across their longest extent."""
    order = np.arange(len(p_site))
    first, last, left, right = [0], [len(order)], [0], [0]
    k = 0
    while k < len(first):
        a, b = first[k], last[k]
        if b - a > 1:
            p = p_site[order[a:b]]
            axis = int(np.argmax(np.ptp(p, axis=0)))
            run = order[a:b][np.argsort(p[:, axis], kind="stable")]
            order[a:b] = run
            x = p_site[run, axis]
            middle = int(np.searchsorted(x, 0.5 * (x[0] + x[-1])))
            middle = a + min(max(middle, 1), b - a - 1)
            left[k], right[k] = len(first), len(first) + 1
            first += [a, middle]
            last += [middle, b]
            left += [0, 0]
            right += [0, 0]
        k += 1
    return Cells(order, *(np.array(one, dtype=np.intp) for one in (first, last, left, right)))


class _Opened(NamedTuple):
    """A node that was opened."""

    bound: float
    # with their bounds; itself if its bound suffices, none of a single arrangement
    children: list[tuple[float, Node]]
    value: float  # sigma of the arrangement nearest to its relaxation [m]
    chosen: Index  # its places
    effort: float


class _Tree:
    """The nodes of branch and bound."""

    def __init__(self, given: Places) -> None:
        self._given = given
        self._cells = _halved(given.p_site)

    def opened(self, some: list[tuple[float, int, Node]], limit: float) -> list[_Opened]:
        """Bound nodes and divide those whose bound is below a limit; on two threads."""

        def part(first: int, last: int) -> list[_Opened]:
            return [self._open(bound, node, limit) for bound, _, node in some[first:last]]

        return [one for few in by_turns(part, len(some), size=1, threaded_from=2) for one in few]

    def _open(self, bound: float, node: Node, limit: float) -> _Opened:
        """Bound one node, and divide it if its bound is below the limit."""
        state = self._state(node)
        found, _, last, steps = _improved(self._given, state, limit)
        bound, effort = max(bound, found), steps * (len(state.places) / _FULL_EVERY + 60.0)
        chosen = _rounded(state, self._given.groups)
        value = self._given.value(chosen)
        if bound >= limit:
            return _Opened(bound, [(bound, node)], value, chosen, effort)
        region = self._widest(state)
        is_end = not self._cells.left[node.cells[region]]
        children = [] if is_end else self._children(node, state, region, (bound, last))
        return _Opened(bound, children, value, chosen, effort)

    def _state(self, node: Node) -> Relaxed:
        """Return the start of a node's relaxation: the shares of the one around it."""
        cells = self._cells
        runs = [cells.order[cells.first[k] : cells.last[k]] for k in node.cells]
        places, begins = np.concatenate(runs), np.cumsum([0, *map(len, runs)])
        known = np.zeros(len(self._given.p_site))
        known[node.places] = node.shares
        shares = known[places]
        totals = np.add.reduceat(shares, begins[:-1])
        shares *= np.repeat(np.array(node.counts) / totals, np.diff(begins))
        return Relaxed(
            places=places,
            begins=begins,
            counts=np.array(node.counts),
            shares=shares,
            scores=np.zeros(len(places)),
            weights=node.weights.copy(),
            sums=np.zeros((len(runs), max(node.counts) + 1)),
        )

    def _widest(self, state: Relaxed) -> int:
        """Return the region whose shares are widest apart, among those of several places."""
        p, shares, first = self._given.p_site[state.places], state.shares, state.begins[:-1]
        total = np.add.reduceat(shares, first)
        middle = np.add.reduceat(shares[:, None] * p, first) / total[:, None]
        spread = np.add.reduceat(shares * np.sum(p * p, axis=1), first)
        spread -= total * np.sum(middle**2, axis=1)
        sizes = np.diff(state.begins)
        return int(np.argmax(np.where(sizes > 1, np.maximum(spread, 0.0) + 1e-6 * sizes, -1.0)))

    def _children(
        self, node: Node, state: Relaxed, region: int, bounds: tuple[float, float]
    ) -> list[tuple[float, Node]]:
        """Divide the marks of a region between its halves, with bounds by the scores of all."""
        cells, n, cell = self._cells, node.counts[region], node.cells[region]
        first, last = state.begins[region : region + 2]
        left, right = int(cells.left[cell]), int(cells.right[cell])
        middle = first + cells.last[left] - cells.first[left]
        own, shares, sums = self._given.groups[state.places], state.shares.copy(), []
        for a, b in ((first, middle), (middle, last)):
            sums.append(np.zeros(n + 1))
            _largest(state.scores, own, np.arange(a, b), sums[-1])
            if shares[a:b].sum() < _FAINT:
                shares[a + int(np.argmax(state.scores[a:b]))] = 1.0
        keep = np.flatnonzero(shares > 0.0)
        at, own_bound = (state.places[keep], shares[keep]), bounds[1] + state.sums[region, n]
        children = []
        for k in range(n + 1):
            bound = max(bounds[0], own_bound - sums[0][k] - sums[1][n - k])
            halves = [part for part in ((left, k), (right, n - k)) if part[1]]
            parts = list(zip(node.cells, node.counts, strict=True))
            parts[region : region + 1] = halves
            if np.isfinite(bound):
                several, counts = zip(*parts, strict=True)
                children.append((bound, Node(several, counts, state.weights, *at)))
        return children


def _improved(given: Places, state: Relaxed, limit: float) -> tuple[float, float, float, int]:
    """Improve a relaxation in place, as ``_solve`` does."""
    rule = limit, given.sigma_height**2, given.is_mean
    bound, upper, last, steps = _solve(given.rows, given.start, given.groups, state, rule)
    return float(bound), float(upper), float(last), int(steps) + 1


def _rounded(state: Relaxed, groups: Index) -> Index:
    """Return the places with the largest shares, as many of each region as it has marks."""
    chosen: list[int] = []
    for r, n in enumerate(state.counts):
        run = slice(state.begins[r], state.begins[r + 1])
        places = state.places[run][np.argsort(-state.shares[run])]
        _, firsts = np.unique(groups[places], return_index=True)
        chosen.extend(places[np.sort(firsts)[:n]])
    return np.array(chosen, dtype=np.intp)


@compiled
def _largest(scores: Array, groups: Index, some: Index, best: Array) -> None:
    """Write the largest sums of 0, 1, 2 and more scores, one of each group, of a region."""
    n = len(best) - 1
    top, of = np.full(n, -1.0), np.full(n, -1)
    for k in some:
        s, g = scores[k], groups[k]
        place = n
        for i in range(n):
            if of[i] == g:
                place = i
                break
        if place < n:
            if s <= top[place]:
                continue
        else:
            place = n - 1
            if s <= top[place]:
                continue
        while place > 0 and top[place - 1] < s:
            top[place], of[place] = top[place - 1], of[place - 1]
            place -= 1
        top[place], of[place] = s, g
    best[0] = 0.0
    for i in range(n):
        best[i + 1] = best[i] + max(top[i], 0.0) if of[i] >= 0 else -np.inf


@compiled_with(fastmath=REASSOCIATED)
def _dot(a: Column, b: Column) -> float:
    """Return the product of two rows."""
    total = np.float32(0.0)
    for i in range(len(a)):
        total += a[i] * b[i]
    return float(total)


@compiled
def _divide(state: Relaxed, groups: Index, r: int, totals: Array) -> None:
    """Scale the shares of a region to the number of its marks, at most one mark in each group."""
    places, shares, n = state.places, state.shares, state.counts[r]
    first, last = state.begins[r], state.begins[r + 1]
    for k in range(first, last):
        totals[groups[places[k]]] = 0.0
    for k in range(first, last):
        totals[groups[places[k]]] += shares[k]
    scale = 0.0
    for _ in range(_ROUNDS if n > 1 else 1):
        n_full, free = 0.0, 0.0
        for k in range(first, last):
            if shares[k] > 0.0:
                total = totals[groups[places[k]]]
                if scale * total >= 1.0:
                    n_full += shares[k] / total
                else:
                    free += shares[k]
        if free > 0.0:
            scale = (n - n_full) / free
    for k in range(first, last):
        if shares[k] > 0.0:
            shares[k] *= min(scale, 1.0 / totals[groups[places[k]]])


@compiled
def _enter(state: Relaxed, r: int) -> None:
    """Give the best place of a region a share, and drop shares that are faint."""
    first, last = state.begins[r], state.begins[r + 1]
    best = first
    for k in range(first, last):
        if state.scores[k] > state.scores[best]:
            best = k
        if state.shares[k] < _FAINT:
            state.shares[k] = 0.0
    if state.shares[best] == 0.0:
        state.shares[best] = _ENTERS * state.counts[r]


@compiled
def _solve(
    rows: Column,
    start: Array,
    groups: Index,
    state: Relaxed,
    rule: tuple[float, float, bool],
) -> tuple[float, float, float, int]:
    """Improve a relaxation until its bound exceeds a limit, cannot, or has settled.

    Returns the best bound, the objective at the best shares (largest variance, or mean sigma), the
    bound of the last scores, and the steps.
    """
    limit, shares, weights = rule[0], state.shares, state.weights
    bound, upper, found, step = 0.0, np.inf, 0.0, 0
    slopes, variances = np.empty(rows.shape[1], np.float32), np.empty(len(start))
    totals = np.zeros(groups.max() + 1)
    for step in range(_STEPS):
        value, free = _linearise(rows, start, state, rule, slopes, variances)
        if not value < np.inf:
            break
        upper, is_full = min(upper, value), step % _FULL_EVERY == 0
        for k in range(len(shares)):
            if is_full or shares[k] > 0.0:
                state.scores[k] = max(_dot(rows[state.places[k]], slopes), 0.0)
        if is_full:
            found = free - _largest_sum(state, groups)
            bound = max(bound, found)
            is_hopeless = upper < limit and step >= _HOPELESS
            if bound >= limit or upper <= _CLOSED * bound or is_hopeless:
                break
        shares *= np.sqrt(state.scores)
        for r in range(len(state.counts)):
            _divide(state, groups, r, totals)
            if is_full:
                _enter(state, r)
                _divide(state, groups, r, totals)
        pace = 0.5 * _PACE / np.sqrt(1.0 + step / 20.0)
        weights *= np.exp(pace * (variances / variances.max() - 1.0))
    return bound, upper, found, step


@compiled
def _linearise(
    rows: Column,
    start: Array,
    state: Relaxed,
    rule: tuple[float, float, bool],
    slopes: Column,
    variances: Array,
) -> tuple[float, float]:
    """Write variances, and slopes of the bound by information; scale weights to a sum of 1.

    Returns the objective, and the constant part of the bound.
    """
    _, height2, is_mean = rule
    normal, squares = np.empty(N_PACKED), np.empty((len(start), N_PACKED))
    slopes[:] = 0.0
    for k in range(len(state.places)):
        if state.shares[k] > 0.0:
            share, row = np.float32(state.shares[k]), rows[state.places[k]]
            for i in range(len(row)):
                slopes[i] += share * row[i]
    for e in range(len(start)):
        for i in range(N_PACKED):
            normal[i] = start[e, i] + slopes[e * N_PACKED + i]
        variances[e] = squares_of(normal, squares[e])
    weights, value, free = state.weights, variances.max(), 0.0
    if is_mean:
        sigmas = np.sqrt(variances + height2)
        weights[:] = 0.5 / sigmas / len(start)
        value = free = sigmas.mean()
    else:
        weights /= weights.sum()
        free = (weights * variances).sum()
    for e in range(len(start)):
        free += weights[e] * variances[e]
        for i in range(N_PACKED):
            free -= weights[e] * start[e, i] * squares[e, i]
            slopes[e * N_PACKED + i] = weights[e] * squares[e, i]
    return value, free


@compiled
def _largest_sum(state: Relaxed, groups: Index) -> float:
    """Return the largest sum of as many scores in each region as it has marks."""
    own, every, total = groups[state.places], np.arange(len(state.places)), 0.0
    for r in range(len(state.counts)):
        first, last = state.begins[r], state.begins[r + 1]
        _largest(state.scores, own, every[first:last], state.sums[r])
        total += state.sums[r, state.counts[r]]
    return total
