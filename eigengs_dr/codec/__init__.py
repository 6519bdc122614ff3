"""Sets of Gaussians in few bytes.

- ``quantization``: Gaussians as integers
- ``hilbert_index``, ``neighbors``: what is near
- ``exact_math``: functions with the same bits on every machine
- ``range_coder``: integers with probabilities as bits
- ``cells``, ``gaussian_model``, ``directions``, ``weights``: the probabilities
- ``egs``, ``egs_section``, ``egs_maps``: the .egs file, its sections, and its table of maps
- ``packing``: `pack`: the largest steps within a loss of PSNR
- ``step_search``: the search of a step by few attempts
- ``error_feedback``: rounding that later Gaussians compensate
"""
