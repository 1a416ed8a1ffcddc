"""Robustness: fuzz frames, killed and stopped processes, full disks, long operation."""
