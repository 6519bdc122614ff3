"""Sets of Gaussians in few bytes.

- ``quantization``: parameters as whole numbers
- ``hilbert_index``: places along a Hilbert curve
- ``entropy``: whole numbers as bytes
- ``egs``: the .egs file
- ``bit_allocation``: `pack`: steps for a loss of PSNR
- ``step_search``: a common factor of the steps, by attempts on a ladder
- ``error_feedback``: rounding that later parameters compensate
"""
