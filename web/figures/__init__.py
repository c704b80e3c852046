"""Plotly figures: from columns, named and in the units of the database."""
