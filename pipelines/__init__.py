"""The core: arrays in, values out; no files, no network, no database, no web.

A survey is a chain of immutable values, and each module turns one into the next:

``ScanLog`` --stitching--> ``StitchedCloud`` --extraction--> ``MarkerCandidates`` --fitting-->
``MarkerFits`` --resection (with control marks)--> ``StationFix``

``survey`` holds the whole chain in memory; ``accuracy`` turns results into statements;
``simulation`` makes logs of a world whose truth is known. ``values`` says what flows, ``config``
what can be chosen, ``errors`` what can go wrong, ``geometry`` is the only changer of frames, and
``adjustment`` the only place where least squares are solved.

Why so: a function of values can be tested against a known truth, run in any worker, and read
without knowing what ran before it.
"""
