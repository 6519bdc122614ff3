"""The same calls on many machines, by Dask; the only folder that imports dask and distributed.

- ``executor``: a client from words, its `eigengs_dr.backend.executor.Executor`, and what a worker
  needs before its first task
"""
