"""How experiments measure: clocks, rows in files, sets of images."""
