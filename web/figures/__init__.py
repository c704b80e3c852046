"""Plotly figures from columns in the units of the database; lengths are drawn in millimetres."""
