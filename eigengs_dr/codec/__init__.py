"""Sets of Gaussians in few bytes.

- ``quantization``: Gaussians as integers
- ``exact_math``: functions with the same bits on every machine
- ``range_coder``: integers with probabilities as bits
- ``cells``: where Gaussians are, without their order
- ``gaussian_model``, ``weights``: the probabilities of all other numbers, from the neighbours
- ``egs``: the .egs file with its table of maps and its sections
- ``packing``: `pack`
- ``rounding``: the largest steps within a loss, and rounding that later Gaussians compensate
"""
