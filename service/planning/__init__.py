"""Plans of marker positions: what is requested, its evaluation and its optimisation."""
