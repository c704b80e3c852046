"""Plotly figures and HTML pages as pure functions of values.

A figure that is a function of values can be tested by its data, axis titles and units. Nothing in
this package knows where values come from.

- ``columns``: tables as columns of the database. ``theme``: colours by role, which
  static/tokens.css gives values.
- ``figures``: columns to Plotly figures; ``figures.elements`` are parts that several share.
- ``pages``: each page as a frozen value and a function to HTML; ``readouts`` are its key numbers,
  ``statements`` the distance and count that keep the tolerance, ``filters`` a view as an address.
- ``templating``, templates/, ``assets``, static/: templates, style sheets, scripts and fonts. Pages
  have no inline script or style, and load nothing from another host.
"""
