"""Files of NumPy arrays, each written completely or not at all."""
