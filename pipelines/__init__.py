"""The core: arrays in, values out; no files, no network, no database, no web.

A survey is a chain of immutable values, and each package turns one into the next:

``ScanLog`` --scan--> ``StitchedCloud`` --detection--> ``MarkerCandidates`` --sphere-->
``MarkerFits`` --positioning (with control marks)--> ``StationFix``

``survey`` holds the whole chain on one screen. ``model`` has the values, ``config`` the options,
``errors`` the errors, ``geometry`` the changes of frame, ``estimation`` the least squares and
tests. ``network``, ``calibration``, ``placement`` and ``ground_model`` rest on the chain;
``simulation`` makes logs of worlds whose truth is known, ``accuracy`` compares with it and decides
whether a survey is accepted, and ``evaluation`` runs experiments.

Why so: a function of values can be tested against a known truth, run in any worker, and read
without knowing what ran before it.
"""
