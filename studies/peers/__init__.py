"""Peers: the speed of many runs and of the RMS grid beside C, jax and NASA ProgPy."""
