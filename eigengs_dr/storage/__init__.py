"""Files of arrays, whole or not at all. NumPy only."""
