"""The same calls on many machines, by Dask; the only folder that imports dask and distributed.

- ``connect``: a client from the words ``local:4``, ``tcp://HOST:PORT`` or a scheduler file
- ``executor``: the `eigengs_dr.backend.executor.Executor` of a client
- ``worker``: what a worker needs before its first task
"""
