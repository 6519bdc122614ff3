"""The files `.egs`: integers of Gaussians in few bytes.

- ``quantization``: Gaussians as integers
- ``exact_math``: functions whose results are bit-identical on every machine
- ``range_coder``: entropy coding of integers with given probabilities, and of the cells of
  Gaussians without their order
- ``gaussian_model``: the probabilities of all other numbers, from neighbours
- ``egs``: the .egs file with its table of maps and its sections
"""
