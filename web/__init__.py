"""What people see: pure functions from values to Plotly figures and HTML pages.

Why so: a picture that is a function of values can be tested by its data, axis titles and units,
and drawn for any result, stored or not. Nothing here knows where values come from.

- ``figures``, ``maps``, ``scene``: columns of the database to Plotly figures: scatters, the field,
  one stop in space. ``theme`` has their colours by role, which static/tokens.css gives values.
- ``pages``: what each page shows, as frozen contexts, and functions from them to HTML; beside it
  ``readouts`` (the numbers at a glance), ``study`` (what keeps the tolerance), ``filters`` (a view
  as an address), ``templating``. ``reproduction`` draws the study again, as a page of its own.
- ``assets`` and static/: style sheets, scripts, fonts. Pages have no script or style of their own,
  and ask no other host.
"""
