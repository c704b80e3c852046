"""How accurate results are, from errors against truth, stated sigmas and differences of results.

``truth`` compares centres and stations with the truth. ``error_model`` fits how errors grow, and
``tolerance`` counts how far they keep a tolerance. ``probability`` is the rule whether a stated
covariance keeps it. ``comparison`` tests the differences of two results. ``acceptance`` tests
whether stated sigmas hold, and decides whether a survey is accepted.
"""
