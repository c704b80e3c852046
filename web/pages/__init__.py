"""Pages: from rows of the catalogue to HTML, through the templates."""
