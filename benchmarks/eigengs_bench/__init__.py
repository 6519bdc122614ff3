"""Measurements of eigengs_dr: what is fast, what is accurate, and where methods fail."""
