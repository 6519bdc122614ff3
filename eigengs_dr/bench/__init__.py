"""Measurements that a command draws again."""
