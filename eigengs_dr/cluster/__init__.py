"""Execution on many machines with Dask; the only folder that imports dask and distributed.

- ``client``: the executor of a client
- ``executor``: connection to a cluster, and its `eigengs_dr.backend.executor.Executor`
- ``worker``: execution of tasks on a worker
- ``local``: workers on this machine
"""
