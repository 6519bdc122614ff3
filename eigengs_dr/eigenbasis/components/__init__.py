"""Shared Gaussians for all components of an eigenbasis."""
