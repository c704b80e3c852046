"""Routes of pages: queries of the catalogue, handed to the functions that draw."""
