"""Linear least squares for the colours of fixed shapes."""
