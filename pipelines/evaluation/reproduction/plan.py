"""The scans to simulate, in series by purpose."""

from __future__ import annotations

from dataclasses import dataclass, replace

from spheremark.pipelines.published import SIGMA_RANGE

OURS, PAPER, FULL_SPHERE, GROUND = "along_beam", "paper", "paper_sphere", "paper_ground"
"""Methods of fitting; then the study's with a full sphere as its model (Figure 3), and with its cut
at the highest ground point."""

CENTRE, LANE_2, TURNS, DISTANCES = "centre", "lane 2", "turns", "distances"
"""Series of scans with the noise of the study's simulator."""

CENTRE_REAL, DISTANCES_REAL = "centre, real noise", "distances, real noise"
"""Series with the noise that real packets of a VLP-16 have."""

TURN = 13.2
"""Default time of a turn [s]."""

STOPS_OF_LANE_2 = tuple(f"lane2-stop{i + 1}" for i in range(7))
"""Stops of the study's Table 4."""

_FIELD, _CENTRE_STOP, _LANE = "paper-field", "lane3-stop4", "range-lane"
_OTHER_TURNS = (4.2, 6.6, 26.4)  # [s]; none commensurate with the pitch of the channels


@dataclass(frozen=True, slots=True, kw_only=True)
class Scan:
    """One simulated scan of the reproduction.

    Attributes
    ----------
    series : str
        Its purpose.
    scenario : str
        World to simulate.
    stop : str
        Stop in it.
    seed : int
        Source of chance of world, rig and sensor.
    turn : float
        Time of the gimbal's turn [s].
    sigma_range : float or None
        Noise of every range [m]; none takes that of real packets, by reflectivity.
    """

    series: str
    scenario: str
    stop: str
    seed: int
    turn: float
    sigma_range: float | None = None

    @property
    def needs_ground(self) -> bool:
        """Whether the ground is simulated too; centres alone need only beams near spheres."""
        return self.scenario == _FIELD


def plan(seed: int, *, is_quick: bool = False) -> tuple[Scan, ...]:
    """Return the scans to simulate.

    Parameters
    ----------
    seed : int
        First of the seeds.
    is_quick : bool
        Fewer worlds and turn times: seconds in place of minutes, with wider intervals.

    Returns
    -------
    tuple of Scan
        The first is of the centre stop.
    """
    n_worlds, n_lanes, n_turned, n_distances = (2, 1, 1, 1) if is_quick else (10, 3, 2, 4)
    n_real = 1 if is_quick else 4
    turns = _OTHER_TURNS[1:2] if is_quick else _OTHER_TURNS
    centre = Scan(
        series=CENTRE,
        scenario=_FIELD,
        stop=_CENTRE_STOP,
        seed=seed,
        turn=TURN,
        sigma_range=SIGMA_RANGE,
    )
    lane = replace(centre, scenario=_LANE, stop="centre")
    far_turns = sorted((*(_OTHER_TURNS[:2] if is_quick else _OTHER_TURNS), TURN))
    return (
        *(replace(centre, seed=seed + i) for i in range(n_worlds)),
        *(
            replace(centre, series=CENTRE_REAL, seed=seed + i, sigma_range=None)
            for i in range(n_real)
        ),
        *(
            replace(centre, series=LANE_2, stop=stop, seed=seed + i)
            for i in range(n_lanes)
            for stop in STOPS_OF_LANE_2
        ),
        *(
            replace(centre, series=TURNS, seed=seed + i, turn=turn)
            for i in range(n_turned)
            for turn in turns
        ),
        *(
            replace(lane, series=series, seed=seed + i, turn=turn, sigma_range=sigma)
            for series, sigma in ((DISTANCES, SIGMA_RANGE), (DISTANCES_REAL, None))
            for i in range(n_distances)
            for turn in far_turns
        ),
    )
