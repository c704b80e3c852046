"""The study again, in simulation: its tables and figures by its own method and by ours.

``plan`` lists the scans; ``reproduction`` (``scans``) simulates each, finds its markers and fits
them; ``tables`` puts the errors against truth into the tables of the study. ``included_angle`` is
the study's controlled experiment with the station (Table 3), which needs no scan; ``noise``
estimates the noise of ranges in any log. Series of scans:

- ``centre``: the centre stop of the study's field, several worlds: Table 2, Figures 8, 9 and 3;
- ``lane 2``: its seven stops: Table 4 and Figure 11;
- ``turns``: the centre stop with other times of a turn: other counts at the same distances;
- ``distances``: eight markers at each of eleven distances to 30 m, with four times of a turn, which
  separate distance from count.

All have the noise of the study's simulator; the centre stop and the distances come again with the
noise of a real sensor.
"""
