"""The measured hot spots, compiled by numba; each has a literal NumPy twin in `tests/reference`."""
