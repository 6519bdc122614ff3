"""Sets of Gaussians in few bytes.

- ``quantization``: Gaussians as integers
- ``exact_math``: functions with the same bits on every machine
- ``range_coder``: integers with probabilities as bits
- ``gaussian_model``, ``weights``: the probabilities, from what is known of the neighbours
- ``egs``, ``egs_section``: the .egs file with its table of maps, and its sections
- ``packing``: `pack`
- ``rounding``: the largest steps within a loss, and rounding that later Gaussians compensate
"""
