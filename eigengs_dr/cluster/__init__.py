"""The same calls on many machines, by Dask; the only folder that imports dask and distributed.

- ``client``: the executor of a client
- ``executor``: a client from words, and its `eigengs_dr.backend.executor.Executor`
- ``worker``: what runs on a worker
- ``local``: workers of this machine
"""
