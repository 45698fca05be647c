"""The measured hot spots, compiled by numba; tests compare them with plain NumPy (`tests/reference`)."""

# For loops over whole images, of finite numbers: what lets them go several pixels at a time.
FAST = {"fastmath": {"contract", "nnan", "ninf", "nsz", "arcp"}, "error_model": "numpy"}
