"""What people see: pure functions from values to Plotly figures and HTML pages.

Why so: a picture that is a function of values can be tested by its data, axis titles and units,
and drawn for any result, stored or not. Nothing here knows where values come from.
"""
