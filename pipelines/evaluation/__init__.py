"""Experiments: worlds of known truth, the methods on them, and tables of the errors.

``experiment`` is the frame: an ``Experiment`` has worlds, runs each in a process, pools what they
gave into a report of plain values, and lays it out in tables. Experiments are ``detection``
(precision and recall of extraction), ``precision`` (centres against the bound), ``networks``
(adjusted surveys), ``worlds`` (the whole chain in random worlds), ``ellipse_coverage`` (stations
against their covariances), ``plans`` (optimised marks against chance), ``promises`` (stations over
what plans promise) and ``reproduction`` (the study's tables and figures). ``data_sheets`` has the
settings of a user who knows the instruments of a random world.

This package rests on all others of the core; only the command line imports it.
"""
