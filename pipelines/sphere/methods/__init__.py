"""The methods by which the centre of a sphere is fitted, one module each."""
