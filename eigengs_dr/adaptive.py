"""placeholder"""
from .place import grid as adaptive
