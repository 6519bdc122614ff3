"""Slow and plain ways to compute what the package computes; they may import its internals."""
