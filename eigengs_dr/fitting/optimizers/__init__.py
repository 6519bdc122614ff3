"""Gradient descent: variables, optimisers and schedules."""
