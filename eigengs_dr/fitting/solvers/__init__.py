"""Linear least squares for colours on fixed shapes."""
